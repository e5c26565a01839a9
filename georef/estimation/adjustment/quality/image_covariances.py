"""Covariances of the images of an adjusted block: their stations, what is not known of mountings, reference errors.

Own ones of all images come from the selected inverse, joint ones of some by solving with the factor, exactly both: a
joint covariance of tens of thousands of images would fit into no memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array

from georef.estimation.adjustment.adjust_block import AdjustedBlock
from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.equations.reduced import Layout
from georef.geometry.covariance import symmetric
from georef.geometry.rigid import Array

_CHUNK = 600  # columns solved for at a time


@dataclass(frozen=True, eq=False)
class ImageCovariances:
    """Right perturbations of world_from_cam, (rad, m) each, of M images, and jointly of k chosen ones: against the
    reference as it is published, and with the errors of the reference."""

    relative: Array  # (M, 6, 6)
    own: Array  # (M, 6, 6)
    images: Indices  # (k,) rising
    relative_joint: Array  # (6 k, 6 k)
    joint: Array  # (6 k, 6 k)


def image_covariances(adjusted: AdjustedBlock, images: Indices) -> ImageCovariances:
    """Own covariances of all images, joint ones of the chosen."""
    block, state, found = adjusted.block, adjusted.solution.state, adjusted.quality
    chosen, references = np.unique(images), found.references
    relative = found.cofactors.images(block, state)
    own = relative if references is None else relative + _from_references(adjusted)
    derivatives = _by_unknowns(block, state, found.cofactors.layout, chosen)
    relative_joint = np.zeros((6 * len(chosen),) * 2)
    for columns in np.array_split(np.arange(6 * len(chosen)), 1 + 6 * len(chosen) // _CHUNK):
        solved = found.cofactors.apply(derivatives[:, columns].toarray())
        relative_joint[:, columns] = derivatives.T @ solved
    relative_joint = symmetric(relative_joint)
    joint = relative_joint if references is None else relative_joint + references.cov(derivatives.toarray())
    return ImageCovariances(relative, own, chosen, relative_joint, joint)


def _from_references(adjusted: AdjustedBlock) -> Array:
    """What the errors of references add to the covariance (M, 6, 6) of each image: once a station where its cameras are
    held on it."""
    block, state, layout = adjusted.block, adjusted.solution.state, adjusted.quality.cofactors.layout
    references = adjusted.quality.references
    assert references is not None
    by_station = state.rig_from_cam.inverse().adjoint()[block.mounting]
    if (layout.mounting < 0).all():
        unit = np.tile(np.eye(6), (layout.stations, 1, 1))
        of_stations = references.of_rows(((6 * np.arange(layout.stations), unit),), 6)
        return by_station @ of_stations[block.station] @ np.swapaxes(by_station, 1, 2)
    first = layout.mounting[block.mounting]
    border = np.where(first >= 0, 6 * layout.stations + first, -1)
    unit = np.tile(np.eye(6), (len(border), 1, 1))
    return references.of_rows(((6 * block.station, by_station), (border, unit)), 6)


def _by_unknowns(block: Block, state: State, layout: Layout, images: Indices) -> csr_array:
    """Derivatives (U, 6 k) of the errors of images by the unknowns of the reduced system."""
    mounting = block.mounting[images]
    blocks = np.swapaxes(state.rig_from_cam.inverse().adjoint()[mounting], 1, 2)
    first = layout.mounting[mounting]
    free = np.flatnonzero(first >= 0)
    rows = np.concatenate([6 * block.station[images], 6 * layout.stations + first[free]])
    columns = 6 * np.concatenate([np.arange(len(images)), free])
    values = np.concatenate([blocks, np.tile(np.eye(6), (len(free), 1, 1))])
    shape, six = values.shape, np.arange(6)
    at = np.broadcast_to(rows[:, None, None] + six[:, None], shape).ravel()
    across = np.broadcast_to(columns[:, None, None] + six, shape).ravel()
    return csr_array(coo_array((values.ravel(), (at, across)), shape=(layout.size, 6 * len(images))))
