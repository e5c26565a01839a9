"""References that contradict the others about one query are left out: single ones, and whole epochs.

What is suspect shows in its matches: they lie farther from the points that all references agree on than the covariances
of points, keypoints and its own pose allow. Only suspects are judged, by their matches as they were found: a reference
is posed from what the others say of its points, as if it were a new image, and compared with its own pose; an epoch is
judged by the query, its pose from this epoch alone against its pose from the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from georef.estimation.first_pose import QueryImage
from georef.estimation.guided import PosedFeatures
from georef.estimation.local_model import LocalModel, query_centred_model
from georef.estimation.pnp import EstimatedPose, refine_pose
from georef.estimation.reference_errors import ReferenceErrors
from georef.geometry.projection import linearize
from georef.geometry.rigid import Array, Rigid3
from georef.types.features import Matches

_SUSPECT = 2.0  # times the residuals that the covariances lead one to expect
_PROBABILITY = 0.9999  # of a reference that is as good as its covariance says
_LEAST_POINTS = 15
_MOST_POINTS = 200  # that a judgement rests on


@dataclass(frozen=True, eq=False)
class Matched:
    """References with what they have in common with a query, in one order."""

    references: Sequence[PosedFeatures]
    matches: Sequence[Matches]
    errors: ReferenceErrors  # of their poses
    epochs: Sequence[str]
    keypoint_sigma: float

    def take(self, views: Sequence[int]) -> Matched:
        """Some of them."""
        return Matched(
            [self.references[v] for v in views],
            [self.matches[v] for v in views],
            self.errors.take(views),
            [self.epochs[v] for v in views],
            self.keypoint_sigma,
        )

    def model(self) -> LocalModel:
        """The points that they agree on."""
        return query_centred_model(self.references, self.matches, self.keypoint_sigma)


@dataclass(frozen=True)
class Contradiction:
    """References that disagree with the others about a query, and by how much."""

    views: tuple[int, ...]
    epoch: str | None  # where they are all that there is of it
    statistic: float  # over its limit
    shift_m: float
    turn_rad: float

    def describe(self, image_id: str) -> str:
        """In words; image_id is that of the first of the references."""
        what = image_id if self.epoch is None else f"epoch {self.epoch} ({len(self.views)} images)"
        by = f"{1e3 * self.shift_m:.0f} mm and {np.degrees(self.turn_rad):.2f} deg"
        return f"{what} contradicts the other references by {by}: left out"


def contradiction(matched: Matched, query: QueryImage, pose: Rigid3, model: LocalModel) -> Contradiction | None:
    """The epoch, else the reference, that contradicts the others most, where one does.

    model: the points that the query's pose rests on, from all of the references.
    """
    suspect = suspects(matched, model)
    if not suspect.any() or len(suspect) < 3:
        return None
    epochs = np.array(matched.epochs)
    of_epochs = [
        _epoch_against_others(matched, epochs == name, query, pose)
        for name in sorted(set(epochs))
        if suspect[epochs == name].mean() >= 0.5 and (epochs != name).any()
    ]
    return _worst(of_epochs) or _worst([_against_others(matched, int(v), model) for v in np.flatnonzero(suspect)])


def contradicting_epoch(matched: Matched, query: QueryImage, pose: Rigid3) -> Contradiction | None:
    """The epoch that contradicts the others most, where one does: each is judged, whatever its matches look like.

    For points that were verified before the query was known, which each epoch may have of its own.
    """
    epochs = np.array(matched.epochs)
    names = sorted(set(matched.epochs))
    return _worst([_epoch_against_others(matched, epochs == name, query, pose) for name in names if len(names) > 1])


def suspects(matched: Matched, model: LocalModel) -> NDArray[np.bool_]:
    """Whether each reference's matches are farther from the model's points than they should be."""
    out = np.zeros(len(matched.references), bool)
    for view, posed in enumerate(matched.references):
        row, keypoint = _matched_points(matched.matches[view], model)
        if len(row) < _LEAST_POINTS:
            continue
        lin = linearize(model.views, np.full(len(row), view), model.points[row])
        sigma = matched.keypoint_sigma * posed.features.scales_px[keypoint].astype(np.float64)
        cov = lin.by_point @ model.cov[row] @ np.swapaxes(lin.by_point, 1, 2)
        cov += lin.by_pose @ matched.errors.cov(view) @ np.swapaxes(lin.by_pose, 1, 2) + np.square(sigma)[
            :, None, None
        ] * np.eye(2)
        residual = lin.pixel - posed.pixels[keypoint]
        shown = np.asarray(np.isfinite(residual).all(axis=1))
        square = np.einsum("ni,nij,nj->n", residual[shown], np.linalg.inv(cov[shown]), residual[shown])
        out[view] = len(square) and float(np.median(square)) > _SUSPECT**2 * chi2.ppf(0.5, 2)
    return out


def _matched_points(matches: Matches, model: LocalModel) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The rows of the model that a reference has a match of, and its keypoints."""
    _, row, which = np.intersect1d(model.keypoint, matches.indices[:, 0], return_indices=True)
    return row, matches.indices[which, 1].astype(np.int64)


def _against_others(matched: Matched, view: int, model: LocalModel) -> Contradiction | None:
    """A reference against its pose from points that the others see."""
    rest = [v for v in range(len(matched.references)) if v != view]
    others = matched.take(rest).model()
    others = _some(others.take(np.isin(others.keypoint, model.keypoint)))
    row, keypoint = _matched_points(matched.matches[view], others)
    if len(row) < _LEAST_POINTS:
        return None
    posed = matched.references[view]
    chosen = np.zeros(len(others), bool)
    chosen[row] = True
    own = np.full(len(others), -1)
    own[row] = keypoint
    local = others.take(chosen)
    local = LocalModel(own[chosen], local.points, local.cov, local.views, local.observations)
    observed = QueryImage(posed.camera, posed.pixels, matched.keypoint_sigma * posed.features.scales_px.astype(float))
    found = refine_pose(posed.world_from_cam, observed, local, matched.errors.take(rest))
    if found is None:
        return None
    difference = posed.world_from_cam.local(found.world_from_cam)
    return _contradiction([view], None, difference, found.cov + matched.errors.cov(view))


def _epoch_against_others(
    matched: Matched, of_epoch: NDArray[np.bool_], query: QueryImage, pose: Rigid3
) -> Contradiction | None:
    """Of two epochs that contradict each other the one that knows the pose less well; None for the other."""
    views = [int(v) for v in np.flatnonzero(of_epoch)]
    alone = _posed_from(matched.take(views), query, pose)
    rest = _posed_from(matched.take([int(v) for v in np.flatnonzero(~of_epoch)]), query, pose)
    if alone is None or rest is None:
        return None
    if len(set(matched.epochs)) == 2 and np.linalg.slogdet(alone.cov)[1] < np.linalg.slogdet(rest.cov)[1]:
        return None
    difference = alone.world_from_cam.local(rest.world_from_cam)
    return _contradiction(views, matched.epochs[views[0]], difference, alone.cov + rest.cov)


def _posed_from(matched: Matched, query: QueryImage, pose: Rigid3) -> EstimatedPose | None:
    model = _some(matched.model())
    if len(model) < _LEAST_POINTS:
        return None
    return refine_pose(pose, query, model, matched.errors)


def _some(model: LocalModel) -> LocalModel:
    chosen = np.zeros(len(model), bool)
    chosen[np.linspace(0, len(model) - 1, min(_MOST_POINTS, len(model))).round().astype(int)] = True
    return model.take(chosen)


def _contradiction(views: Sequence[int], epoch: str | None, difference: Array, cov: Array) -> Contradiction:
    statistic = float(difference @ np.linalg.solve(cov, difference)) / float(chi2.ppf(_PROBABILITY, 6))
    shift, turn = float(np.linalg.norm(difference[3:])), float(np.linalg.norm(difference[:3]))
    return Contradiction(tuple(views), epoch, statistic, shift, turn)


def _worst(found: Sequence[Contradiction | None]) -> Contradiction | None:
    beyond = [c for c in found if c is not None and c.statistic > 1.0]
    return max(beyond, key=lambda c: c.statistic, default=None)
