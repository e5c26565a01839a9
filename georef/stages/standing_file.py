"""An adjustment that stands, on disk beside its result, and where the next one of an epoch finds it."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from georef.estimation.adjustment.blunders.gates import RejectedConstraint
from georef.estimation.adjustment.campaign.standing import Standing
from georef.geometry.poses import Poses
from georef.io.items import camera_of, item_path, read_item, write_item
from georef.stages.base import StageContext
from georef.stages.earlier import earlier_runs
from georef.stages.fingerprints import plain_digest
from georef.stages.localize import ITEMS

STANDING = "standing.npz"
_ASIDE = ("control points", "mountings", "stage features", "stage localize", "stage stations")


def adjustment_inputs(context: StageContext) -> dict[str, str]:
    """Digests of the outcome of every image, its mounting, every control point and its marks."""
    survey = context.survey
    folder = context.before.get("stations", context.before["localize"]) / ITEMS
    found = {
        f"image {image.image_id}": hashlib.sha256(item_path(folder, image.image_id).read_bytes()).hexdigest()
        for image in survey.epoch.images
    }
    found |= {f"mounting {name}": plain_digest(mounting) for name, mounting in survey.epoch.mountings.items()}
    for point in survey.control:
        found[f"control {point.point_id}"] = plain_digest(replace(point, marks=()))
        found |= {f"mark {point.point_id} in {mark.image_id}": plain_digest(mark) for mark in point.marks}
    return found


def standing_before(context: StageContext, inputs: dict[str, str]) -> tuple[Standing, Path] | None:
    """The newest adjustment of the epoch to which this one only adds, if it has images enough to be worth it."""
    least = context.config.adjust.update_from_images
    for folder, before in earlier_runs(context, "adjust", _ASIDE) if least else ():
        added = before.items() <= inputs.items() and (folder / STANDING).is_file() and (folder / "stage.json").is_file()
        if added and len((standing := read_standing(folder)).image_ids) >= least:
            return standing, folder
    return None


def write_standing(folder: Path, standing: Standing) -> None:
    header = {
        "station_ids": standing.station_ids,
        "image_ids": standing.image_ids,
        "mountings": standing.mountings,
        "cameras": [asdict(camera) for camera in standing.cameras],
        "antennas": standing.antennas,
        "out_point": standing.out_point,
        "constraints": sorted(standing.constraints),
        "coherent": sorted(standing.coherent),
        "rejected": [asdict(rejected) for rejected in standing.rejected],
        "sigma_scale": standing.sigma_scale,
    }
    arrays = {
        "rig_rotation": standing.world_from_rig.rotation,
        "rig_translation": standing.world_from_rig.translation,
        "station_cov": standing.station_cov,
        "cam_rotation": standing.rig_from_cam.rotation,
        "cam_translation": standing.rig_from_cam.translation,
        "lever_arms_m": standing.lever_arms_m,
        "drift_m": standing.drift_m,
        "out_image": standing.out_image,
        "out_keypoint": standing.out_keypoint,
    }
    write_item(folder / STANDING, header, arrays)


def read_standing(folder: Path) -> Standing:
    """Raises StageError for a file that is missing or damaged."""
    header, arrays = read_item(folder / STANDING)

    def keys(name: str) -> frozenset[tuple[str, str]]:
        return frozenset((kind, called) for kind, called in header[name])

    return Standing(
        station_ids=tuple(header["station_ids"]),
        image_ids=tuple(header["image_ids"]),
        world_from_rig=Poses(arrays["rig_rotation"], arrays["rig_translation"]),
        station_cov=arrays["station_cov"],
        mountings=tuple(header["mountings"]),
        rig_from_cam=Poses(arrays["cam_rotation"], arrays["cam_translation"]),
        cameras=tuple(camera_of(camera) for camera in header["cameras"]),
        antennas=tuple(header["antennas"]),
        lever_arms_m=arrays["lever_arms_m"],
        drift_m=arrays["drift_m"],
        out_image=arrays["out_image"].astype(np.int64),
        out_keypoint=arrays["out_keypoint"].astype(np.int64),
        out_point=tuple(header["out_point"]),
        constraints=keys("constraints"),
        rejected=tuple(RejectedConstraint(**rejected) for rejected in header["rejected"]),
        coherent=keys("coherent"),
        sigma_scale=header["sigma_scale"],
    )
