"""Stage `network`: the uncertainty of the reference and of its keypoints, from the reference alone."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from georef.errors import StageError
from georef.estimation.guided import GuidedOptions, PosedFeatures
from georef.estimation.reference_network import (
    START_KEYPOINT,
    NetworkResult,
    choose_images,
    estimate_noise,
    match_network,
)
from georef.geometry.rigid import Rigid3
from georef.io.files import write_text_atomically
from georef.stages.base import StageContext, StageSummary, feature_id, open_features
from georef.stages.features import failed_images
from georef.types.campaign import Image
from georef.types.results import ReferenceNoise

RESULT = "reference.json"
COMMON = (
    "What is common to all reference images (a shift, a rotation, a scale of the whole) leaves no residual among them "
    "and is not observable here; it is not part of any sigma in this report."
)
SHARED = (
    "Given orientations and image matches disagree smoothly: by as much as this, neighbouring images deviate alike. "
    "The reference is bent, or its cameras are held a little wrong. A new image rests on neighbours and moves with "
    "them: this is no part of any sigma in this report, and shows in full between distant places."
)


def run(context: StageContext) -> StageSummary:
    """Matches a sample of reference images under their known geometry and estimates variance components."""
    config = context.config
    images = _usable_reference(context)
    chosen = [images[i] for i in choose_images(_positions(images), config.network.max_images)]
    store = open_features(context.before["store"])
    posed = [
        PosedFeatures.of(store.read(feature_id(image), config.network.max_keypoints), image.camera, _pose(image))
        for image in chosen
    ]
    options = GuidedOptions.of(config.localize)
    matches = match_network(posed, config.network.neighbours, options, context.executor.progress)
    result = estimate_noise(posed, matches, config.network, config.adjust, declared_noise(chosen))
    suspects = [chosen[i].image_id for i in result.suspects]
    data = _as_data(result, suspects)
    write_text_atomically(json.dumps(data, indent=1), context.folder / RESULT)
    noise = result.noise
    line = (
        f"reference sigma {noise.source}: position {1e3 * noise.position_sigma_m[0]:.1f} mm, rotation "
        f"{np.degrees(noise.rotation_sigma_rad[0]):.4f} deg, from {result.points} points in {result.images} images"
    )
    if result.smooth is not None:
        line += (
            f"; beside {1e3 * result.smooth.position_m:.1f} mm, {np.degrees(result.smooth.rotation_rad):.4f} deg that "
            f"images within {result.smooth.reach_m:.0f} m and {np.degrees(result.smooth.reach_rad):.0f} deg share"
        )
    if suspects:
        line += f"; set aside, in contradiction to the others: {', '.join(suspects)}"
    return StageSummary(line, data, len(chosen), len(chosen))


def read_noise(folder: Path) -> tuple[ReferenceNoise, tuple[str, ...]]:
    """The result of this stage: the noise, and the reference images to leave aside."""
    data = json.loads((folder / RESULT).read_text(encoding="utf-8"))
    noise = ReferenceNoise(
        keypoint_sigma=data["keypoint_sigma"],
        position_sigma_m=tuple(data["position_sigma_m"]),
        rotation_sigma_rad=tuple(data["rotation_sigma_rad"]),
        source=data["source"],
        widening_angle_rad=np.inf if data["widening_angle_rad"] is None else data["widening_angle_rad"],
    )
    return noise, tuple(data["suspects"])


def _usable_reference(context: StageContext) -> list[Image]:
    skipped = failed_images(context.before["features"])
    usable = [image for image in context.survey.reference.images if feature_id(image) not in skipped]
    if len(usable) < 2:
        raise StageError(
            f"Only {len(usable)} of {len(context.survey.reference.images)} reference images can be used.",
            "Expected at least two that can be read and have the size of their camera.",
            "Correct the images, or the camera table; the stage `features` lists what is wrong with each.",
        )
    return usable


def _pose(image: Image) -> Rigid3:
    assert image.world_from_cam is not None
    return image.world_from_cam


def _positions(images: list[Image]) -> np.ndarray:
    return np.array([_pose(image).translation for image in images])


def declared_noise(images: list[Image]) -> ReferenceNoise | None:
    """The declared sigmas of reference images: the root mean square where epochs differ; None if not declared.

    Localization takes each image's own (`ReferenceMap.pose_cov`); the network, which only weighs them against the
    noise of keypoints, takes these for all.
    """
    given = [image.given_sigma for image in images if image.given_sigma is not None]
    if len(given) < len(images):
        return None
    if len(set(given)) == 1:
        position, rotation = given[0].position_m, given[0].rotation_rad
    else:
        position, rotation = _rms([s.position_m for s in given]), _rms([s.rotation_rad for s in given])
    return ReferenceNoise(START_KEYPOINT, position, rotation, "declared")


def _rms(values: list[tuple[float, float, float]]) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in np.sqrt(np.mean(np.square(values), axis=0)))
    return x, y, z


def _as_data(result: NetworkResult, suspects: list[str]) -> dict:
    noise = result.noise
    return {
        "source": noise.source,
        "keypoint_sigma": noise.keypoint_sigma,
        "position_sigma_m": list(noise.position_sigma_m),
        "rotation_sigma_rad": list(noise.rotation_sigma_rad),
        "widening_angle_rad": noise.widening_angle_rad if np.isfinite(noise.widening_angle_rad) else None,
        "suspects": suspects,
        "images": result.images,
        "points": result.points,
        "observations": result.observations,
        "components": {
            name: {"factor": c.factor, "redundancy": c.redundancy, "observations": c.observations}
            for name, c in result.components.items()
        },
        "shared_by_neighbours": None if result.smooth is None else {**asdict(result.smooth), "meaning": SHARED},
        "not_observable": COMMON,
    }
