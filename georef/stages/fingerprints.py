"""What a stage's fingerprint hashes of its inputs: tables and image files as the project declares them.

Each function gives parts by name, so that a changed one can be named.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from georef.config import Config
from georef.project import Project
from georef.stages import features
from georef.stages.base import feature_id
from georef.stages.epoch_constraints import check_declared
from georef.stages.survey import Survey
from georef.types.campaign import Campaign


def reference_files(project: Project, survey: Survey) -> dict[str, Any]:
    return {
        "crs": project.file.crs.model_dump(),
        "reference": {name: section.model_dump() for name, section in project.file.reference_epochs.items()},
        "reference tables": _digest(survey.reference),
    }


def epoch_files(project: Project, survey: Survey) -> dict[str, Any]:
    return {"epoch tables": _digest(survey.epoch)}


def mountings(project: Project, survey: Survey) -> dict[str, Any]:
    return {"mountings": digest_of([[name, _plain(mounting)] for name, mounting in survey.epoch.mountings.items()])}


def all_images(project: Project, survey: Survey) -> dict[str, Any]:
    return {"images": _states_of(survey, survey.reference, survey.epoch)}


def reference_with_images(project: Project, survey: Survey) -> dict[str, Any]:
    features_version = features.extractor_version(project.config.features)
    reference = {"features": features_version, "images": _states_of(survey, survey.reference)}
    return {**reference_files(project, survey), **reference}


def control(project: Project, survey: Survey) -> dict[str, Any]:
    return {"control points": digest_of([_plain(p) for p in survey.control])}


def control_and_mountings(project: Project, survey: Survey) -> dict[str, Any]:
    return {**control(project, survey), **mountings(project, survey), **beside_images(project, survey)}


def beside_images(project: Project, survey: Survey) -> dict[str, Any]:
    """What an epoch declares of antenna, offsets, motions, distances and calibrations, with the states of its files."""
    section = project.file.epochs[survey.epoch.epoch]
    names = ("antenna", "gnss_offset", "motions", "trajectory", "distances", "calibration", "mountings")
    declared = section.model_dump(include=set(names), exclude_defaults=True)
    if not declared:
        return {}
    check_declared(project, survey)
    files = [section.motions, section.trajectory and section.trajectory.file]
    files += [section.distances and section.distances.file, section.distances and section.distances.marks]
    states = [_state(project.data(name)) for name in files if name]
    measured = digest_of([[name, _plain(fix)] for name, fix in survey.epoch.fixes.items()])
    return {"declared": declared, "files": states, "fixes": measured, "times": dict(survey.epoch.times_s)}


def check(project: Project, survey: Survey) -> dict[str, Any]:
    return {"check points": digest_of([_plain(p) for p in survey.check]), **reference_files(project, survey)}


def image_inputs(survey: Survey, failed: Mapping[str, object]) -> dict[str, str]:
    """Of each image of the epoch a digest of all that is said of it, of its file, and of why it has no features."""
    cut = {cutout.path for cutout in survey.cutouts}
    return {
        image.image_id: digest_of(
            [
                *(_plain(image), _state(survey.source_of(image))),
                *(image.path in cut, _plain(survey.epoch.mountings.get(image.image_id)), failed.get(feature_id(image))),
            ]
        )
        for image in survey.epoch.images
    }


def plain_digest(value: Any) -> str:
    """A hash of a dataclass of arrays, numbers and texts."""
    return digest_of(_plain(value))


def setting(config: Config, name: str) -> Any:
    """A section of the configuration as plain values, or one key of it."""
    section, _, key = name.partition(".")
    values = getattr(config, section).model_dump()
    return values[key] if key else values


def _digest(campaign: Campaign) -> str:
    """A hash of all that the tables say of the images of a campaign."""
    return digest_of([_plain(image) for image in campaign.images])


def _plain(value: Any) -> Any:
    """A value as JSON: dataclasses as their fields, arrays as lists, paths by their name."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Path):
        return value.name
    if isinstance(value, (tuple, list)):
        return [_plain(v) for v in value]
    return value


def _states_of(survey: Survey, *campaigns: Campaign) -> str:
    """A hash of what decides the features of images: their files, how they are cut, their keys and sizes."""
    return digest_of(
        [
            [
                feature_id(image),
                image.path.name,
                image.camera.width,
                image.camera.height,
                _state(survey.source_of(image)),
            ]
            for campaign in campaigns
            for image in campaign.images
        ]
    )


def _state(path: Path) -> list[Any]:
    try:
        status = path.stat()
    except OSError:
        return [path.name, None, None]
    return [path.name, status.st_size, status.st_mtime_ns]


def digest_of(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()
