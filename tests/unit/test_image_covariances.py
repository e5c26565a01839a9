"""Covariances of images: own ones of all, joint ones of some, against the dense inverse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from georef.estimation.adjustment.adjust_block import BlockOptions, adjust_block
from georef.estimation.adjustment.block import KINDS_OF_POINT, Block, ReferenceRays
from georef.estimation.adjustment.equations.eliminate import normal_equations
from georef.estimation.adjustment.quality.image_covariances import image_covariances
from georef.estimation.reference_errors import ReferenceErrors
from tests.worlds.rig_blocks import rig_block


def _with_references(block: Block) -> Block:
    """Given points become automatic ones that owe their place to two references."""
    priors = block.point_priors
    kind = np.full(len(priors), KINDS_OF_POINT.index("automatic"))
    rng = np.random.default_rng(0)
    rays = ReferenceRays(
        np.repeat(priors.point, 2),
        np.tile([0, 1], len(priors)),
        rng.normal(size=(2 * len(priors), 3, 6)),
        ReferenceErrors.independent(np.tile(np.diag([1e-4] * 3 + [3e-3] * 3) ** 2, (2, 1, 1))),
    )
    full = np.linalg.matrix_rank(priors.information) == 3
    information = np.where(full[:, None, None], priors.information, 1e4 * np.eye(3))
    return replace(block, point_priors=replace(priors, kind=kind, information=information), reference_rays=rays)


@pytest.mark.parametrize("held", [True, False])
@pytest.mark.parametrize("references", [True, False])
def test_they_are_those_of_the_dense_inverse(held: bool, references: bool) -> None:
    block = rig_block(6).block
    if held:
        block = replace(block, mountings=tuple(replace(m, information=None) for m in block.mountings))
    if references:
        block = _with_references(block)
    adjusted = adjust_block(block, BlockOptions.of(2.0))
    block, state, count = adjusted.block, adjusted.solution.state, len(adjusted.block.image_ids)
    found = image_covariances(adjusted, np.arange(count))
    lin = normal_equations(block, state)
    inverse, layout = np.linalg.inv(lin.reduced.dense()), lin.reduced.layout
    by = np.zeros((6 * count, layout.size))
    for i, (station, mounting) in enumerate(zip(block.station, block.mounting, strict=True)):
        rows = slice(6 * i, 6 * i + 6)
        by[rows, 6 * station : 6 * station + 6] = state.rig_from_cam[int(mounting)].inverse().adjoint()
        if layout.mounting[mounting] >= 0:
            first = 6 * layout.stations + layout.mounting[mounting]
            by[rows, first : first + 6] = np.eye(6)
    expected = by @ inverse @ by.T
    scale = np.sqrt(np.diag(expected))
    assert np.abs((found.relative_joint - expected) / scale / scale[:, None]).max() < 1e-7
    for joint, own in ((found.relative_joint, found.relative), (found.joint, found.own)):
        for i in range(count):
            here = slice(6 * i, 6 * i + 6)
            assert np.abs((own[i] - joint[here, here]) / scale[here] / scale[here, None]).max() < 1e-8
    added = np.diag(found.joint) / np.diag(found.relative_joint)
    assert added.max() > 1.01 if references else added.max() == 1.0
    assert np.linalg.eigvalsh(found.joint / scale / scale[:, None]).min() > -1e-9
    some = image_covariances(adjusted, np.array([7, 2, 5]))
    assert some.images.tolist() == [2, 5, 7]
    rows = (6 * some.images[:, None] + np.arange(6)).ravel()
    assert np.abs(some.joint - found.joint[np.ix_(rows, rows)]).max() < 1e-12
