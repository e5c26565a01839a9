"""An image as a part of a station: what it shows, how it is mounted, what came of it alone, and of it together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from georef.config import LocalizeConfig
from georef.estimation.guided import PosedFeatures
from georef.estimation.prior_check import against_prior
from georef.estimation.reference_map import ReferenceMap
from georef.estimation.station_problem import Member
from georef.estimation.station_solve import SolvedStations
from georef.geometry.rigid import Array, Rigid3
from georef.types.campaign import Image, Mounting
from georef.types.results import Localized, Outcome, ReferenceMatches


@dataclass(frozen=True, eq=False)
class StationImage:
    """One image of a station: what it shows, how it is mounted, and what came of it alone."""

    image: Image
    features: PosedFeatures  # any pose
    mounting: Mounting
    outcome: Outcome

    @property
    def usable(self) -> bool:
        """Whether it has a pose and a camera that is not the image's own to estimate."""
        return isinstance(self.outcome, Localized) and self.outcome.camera is None

    def member(self, station: int, matches: tuple[ReferenceMatches, ...] | None = None) -> Member:
        found = self.outcome.matches if isinstance(self.outcome, Localized) else ()
        given = found if matches is None else matches
        return Member(self.image.image_id, station, self.mounting, self.features, given)


def station_of(image: StationImage) -> Rigid3:
    """world_from_rig as a localized image has it."""
    assert isinstance(image.outcome, Localized)
    return image.outcome.world_from_cam @ image.mounting.rig_from_cam.inverse()


def outcomes_of(
    solved: SolvedStations,
    reference: ReferenceMap,
    images: Sequence[StationImage],
    members: Sequence[int],
    localize: LocalizeConfig,
) -> list[Outcome]:
    """Outcomes of some members of a solved problem (the images are theirs), each with its share of the matches."""
    poses, (covs, relative) = solved.poses(), solved.covs(reference)
    out = []
    for image, member in zip(images, members, strict=True):
        points, keypoints, matches = _evidence(solved, member, reference)
        outcome = Localized(
            image_id=image.image.image_id,
            world_from_cam=poses[member],
            world_from_cam_cov=covs[member],
            relative_cov=relative[member],
            correspondence_count=len(points),
            sigma0=solved.sigma0,
            matches=matches,
            points_in_world=points,
            keypoints=keypoints,
            quarter_turns=image.features.features.quarter_turns,
            notes=image.outcome.notes,
            cpu_s=image.outcome.cpu_s,
            candidates=image.outcome.candidates,
        )
        out.append(against_prior(outcome, image.image, localize))
    return out


def _evidence(
    solved: SolvedStations, member: int, reference: ReferenceMap
) -> tuple[Array, NDArray[np.int64], tuple[ReferenceMatches, ...]]:
    """The points with positions that a member sees, its keypoints, and its matches with the references behind them."""
    problem = solved.problem
    obs = problem.observations
    own = solved.inliers & (obs.view == member) & ~problem.free[obs.point]
    point_of = np.full(len(problem.members[member].features.features), -1, np.int64)
    point_of[obs.keypoint[own]] = obs.point[own]
    index = {image.image_id: i for i, image in enumerate(reference.images)}
    matches = []
    for found in problem.members[member].matches:
        place = index[found.reference_id]
        rays = problem.ray_reference == place
        behind = np.full(len(reference.posed(place).features), -2, np.int64)
        behind[problem.ray_keypoint[rays]] = problem.ray_point[rays]
        same = point_of[found.indices[:, 0]] == behind[found.indices[:, 1]]
        if same.any():
            matches.append(ReferenceMatches(found.reference_id, found.indices[same]))
    return problem.given[obs.point[own]], obs.keypoint[own], tuple(matches)
