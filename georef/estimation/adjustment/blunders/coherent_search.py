"""The search for coherent blocks in a block at its robust solution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.blunders.coherent import CoherentSearch, coherent_blocks
from georef.estimation.adjustment.blunders.shift_rows import AUTOMATIC, shift_rows, shift_system, with_singles_weighted
from georef.estimation.adjustment.equations.constraint_terms import POSE_PRIORS
from georef.estimation.adjustment.equations.eliminate import Losses, normal_equations
from georef.estimation.adjustment.equations.prepared import Prepared
from georef.estimation.adjustment.quality.block_quality import inverted


def search_coherent(
    block: Block, state: State, losses: Losses, *, reference_m: float = 0.01, prepared: Prepared | None = None
) -> CoherentSearch:
    """Wrong stretches of localized poses and automatic GCPs at a robust solution: these with their full weight, all
    else with that of its loss, so that its single blunders do not bend the network. Surveyed control and GNSS are
    never part of a stretch; they are what it is held against."""
    prepared = prepared or Prepared.of(block)
    tested = shift_rows(block, state, prepared.layout, losses)
    if not len(tested):
        return CoherentSearch((), False)
    block = with_singles_weighted(block, state, tested, losses)
    rest = {kind: scale for kind, scale in losses.items() if kind not in (POSE_PRIORS, AUTOMATIC)}
    lin = normal_equations(block, state, losses=rest, prepared=prepared)
    found = inverted(block, state, lin, prepared)
    system = shift_system(block, state, found, lin.reduced.gradient, tested, rest)
    return coherent_blocks(block, system, reference_m=reference_m)


def shared_by_references(block: Block) -> float:
    """Typical 1-sigma (m) of what the errors of its references do to an automatic GCP."""
    rays = block.reference_rays
    if rays is None or not len(rays.point):
        return 0.0
    covs = np.array([rays.errors.cov(view) for view in range(len(rays.errors))])[rays.reference]
    own = np.einsum("nij,njk,nik->n", rays.by_reference_pose, covs, rays.by_reference_pose) / 3.0
    total = np.bincount(rays.point, weights=own)
    return float(np.sqrt(np.median(total[np.unique(rays.point)])))


def without_named(block: Block, search: CoherentSearch) -> Block:
    """The block without what the search named; its points stay, as tie points."""
    poses, points = named_rows(block, search)
    return replace(block, pose_priors=block.pose_priors.take(~poses), point_priors=block.point_priors.take(~points))


def named_rows(block: Block, search: CoherentSearch) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of pose priors and of point priors that the search named."""
    poses, points = np.zeros(len(block.pose_priors), bool), np.zeros(len(block.point_priors), bool)
    for wrong in search.blocks:
        poses[wrong.poses] = True
        points[wrong.points] = True
    return poses, points
