"""Which cameras of an epoch the adjustment estimates, and how well their calibration is known."""

from __future__ import annotations

from georef.errors import ConfigError
from georef.estimation.adjustment.block import Block
from georef.estimation.adjustment.epoch_constraints import with_calibrations
from georef.geometry.camera import PLAIN
from georef.geometry.lenses import MODELS
from georef.project import Project
from georef.stages.survey import Survey


def calibrated(project: Project, survey: Survey, block: Block) -> Block:
    """The block with the cameras that the adjustment estimates. Raises ConfigError as `declared_sigmas` does."""
    sigmas = declared_sigmas(project, survey)
    return with_calibrations(block, sigmas) if sigmas else block


def declared_sigmas(project: Project, survey: Survey) -> dict[str, dict[str, float]]:
    """1-sigma of each estimated parameter by camera, inf: free. Raises ConfigError for cameras and parameters that
    there are not."""
    declared = project.file.epochs[survey.epoch.epoch].calibration
    if not declared:
        return {}
    cameras = {image.camera.camera_id: image.camera for image in survey.epoch.images}
    where = f"epochs.{survey.epoch.epoch}.calibration"
    if project.config.adjust.constraints == "pose-priors":
        raise ConfigError(
            f"The key '{where}' has cameras estimated, and adjust.constraints is 'pose-priors': the localized poses "
            "were computed with the cameras held.",
            "Set adjust.constraints to 'auto-gcps' or 'none', or leave out the calibration.",
        )
    wrong = [name for name in declared if name != "*" and name not in cameras]
    if wrong:
        raise ConfigError(
            f"The key '{where}' names the camera '{wrong[0]}', which took no image of the epoch.",
            f'Expected "*" or some of: {", ".join(list(cameras)[:10])}.',
        )
    sigmas = {
        name: {key: _sigma(where, name, key, value) for key, value in declared.get(name, declared.get("*", {})).items()}
        for name in cameras
    }
    for name, camera in cameras.items():
        model = "brown" if camera.model == "pinhole" else camera.model  # which a distortion makes of it
        possible = (*PLAIN, *MODELS[model].parameters)
        foreign = [key for key in sigmas[name] if key not in possible]
        if foreign:
            raise ConfigError(
                f"The key '{where}' has '{foreign[0]}' of camera '{name}', which the model {model} does not have.",
                f"Expected some of: {', '.join(possible)}.",
            )
    return sigmas


def _sigma(where: str, camera: str, name: str, value: float | str) -> float:
    if isinstance(value, str):
        return float("inf")
    if value > 0:
        return value
    raise ConfigError(
        f"The key '{where}.{camera}.{name}' has the value {value}.",
        'Expected a positive 1-sigma in the unit of the parameter (focal, cx, cy: px), or "free".',
        "Leave the parameter out to hold it.",
    )
