"""A rig of cameras in the court: its photographs, what each of them tells alone, and its calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from georef.config import LocalizeConfig
from georef.estimation.first_pose import QueryImage
from georef.estimation.local_model import query_centred_model
from georef.estimation.pnp import refine_pose
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.station_image import StationImage
from georef.geometry.rigid import Array, Rigid3, exp_so3
from georef.types.campaign import Mounting
from georef.types.results import Localized, ReferenceMatches, Rejected, RejectReason
from tests.worlds.points import NOISE, Seen, World, common, court, disturbed, new_image, photograph, reference_map

RIG_SIGMAS = np.array([np.radians(0.01)] * 3 + [0.001] * 3)
LOCALIZE = LocalizeConfig(guided_min_similarity=0.5)
_TURNS = ((0.0, -0.5, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.1))
_PLACES = ((-0.4, 0.0, 0.0), (0.4, 0.1, 0.2), (0.0, -0.3, 0.0))


@dataclass(frozen=True, eq=False)
class Exposure:
    """One exposure: the true pose of its rig, its photographs and what the survey has of them."""

    world_from_rig: Rigid3
    seen: tuple[Seen, ...]
    images: tuple[StationImage, ...]

    def truth(self, index: int) -> Rigid3:
        return self.seen[index].truth


@dataclass(frozen=True, eq=False)
class RigSurvey:
    world: World
    reference: ReferenceMap
    exposures: tuple[Exposure, ...]


def rig_survey(
    seed: int,
    *,
    cameras: int = 2,
    exposures: int = 1,
    points: int = 170,
    references: int = 6,
    calibrated: Array | None = RIG_SIGMAS,
) -> RigSurvey:
    """New errors of everything; `calibrated`: sigmas (6,) of the mountings, None for an exact rig."""
    rng = np.random.default_rng(seed)
    world = court(7, points=points, references=references, queries=max(exposures, 2))
    photos = [photograph(world, pose, rng) for pose in world.references]
    reference = reference_map(photos, [disturbed(pose, NOISE, rng) for pose in world.references])
    true = [Rigid3(exp_so3(turn), np.array(place)) for turn, place in zip(_TURNS, _PLACES, strict=True)][:cameras]
    rig = [_calibration(f"camera {k}", pose, calibrated, rng) for k, pose in enumerate(true)]
    made = [_exposure(n, world, reference, photos, true, rig, rng) for n in range(exposures)]
    return RigSurvey(world, reference, tuple(made))


def _calibration(name: str, true: Rigid3, sigmas: Array | None, rng: np.random.Generator) -> Mounting:
    if sigmas is None:
        return Mounting(name, true)
    return Mounting(name, true.retract(sigmas * rng.normal(size=6)), np.diag(np.square(sigmas)))


def _exposure(
    number: int,
    world: World,
    reference: ReferenceMap,
    photos: Sequence[Seen],
    true: Sequence[Rigid3],
    rig: Sequence[Mounting],
    rng: np.random.Generator,
) -> Exposure:
    pose = world.queries[number]
    seen = tuple(photograph(world, pose @ mounted, rng) for mounted in true)
    images = []
    for k, (photo, mounting) in enumerate(zip(seen, rig, strict=True)):
        image = replace(new_image(f"{number}/{k}", camera=photo.camera), station=str(number))
        outcome = alone(image.image_id, photo, reference, photos)
        images.append(StationImage(image, photo.posed(), mounting, outcome))
    return Exposure(pose, seen, tuple(images))


def alone(name: str, photo: Seen, reference: ReferenceMap, photos: Sequence[Seen]) -> Localized:
    """The outcome of one image by itself, from all of its true matches."""
    matches = [common(photo, other) for other in photos]
    posed = [reference.posed(i) for i in range(len(photos))]
    model = query_centred_model(posed, matches, NOISE.keypoint_sigma)
    query = QueryImage(
        photo.camera, photo.posed().pixels, NOISE.keypoint_sigma * photo.features.scales_px.astype(float)
    )
    found = refine_pose(photo.truth, query, model, reference.errors(range(len(photos))))
    assert found is not None
    used = model.take(found.inliers)
    return Localized(
        image_id=name,
        world_from_cam=found.world_from_cam,
        world_from_cam_cov=found.cov,
        relative_cov=found.relative_cov,
        correspondence_count=len(used),
        sigma0=found.sigma0,
        matches=tuple(ReferenceMatches(f"r{i}", m.indices) for i, m in enumerate(matches)),
        points_in_world=used.points,
        keypoints=used.keypoint,
    )


def rejected(image: StationImage) -> StationImage:
    """The image as if it had been rejected."""
    return replace(image, outcome=Rejected(image.image.image_id, RejectReason.FEW_MATCHES, "as a test"))


def moved(image: StationImage, step: Sequence[float]) -> StationImage:
    """The image with a pose that is off by a step (6,), rad and m, and says nothing of it."""
    assert isinstance(image.outcome, Localized)
    return replace(image, outcome=replace(image.outcome, world_from_cam=image.outcome.world_from_cam.retract(step)))
