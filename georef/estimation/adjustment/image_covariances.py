"""Covariances of the images of an adjusted block: their stations, what is not known of mountings, reference errors."""

from __future__ import annotations

import numpy as np

from georef.estimation.adjustment.adjust_block import AdjustedBlock
from georef.geometry.covariance import symmetric
from georef.geometry.rigid import Array


def image_covariances(adjusted: AdjustedBlock) -> tuple[Array, Array]:
    """Joint covariances (6M, 6M) of all M images, right perturbations of world_from_cam, (rad, m) each: against the
    reference as it is published, and with the errors of the reference. Dense: for some 2,000 images."""
    derivatives = _by_unknowns(adjusted)
    relative = symmetric(derivatives.T @ adjusted.quality.cofactors.apply(derivatives))
    references = adjusted.quality.references
    return relative, relative if references is None else relative + references.cov(derivatives)


def _by_unknowns(adjusted: AdjustedBlock) -> Array:
    """Derivatives (U, 6M) of the errors of all images by the unknowns of the reduced system."""
    block, layout = adjusted.block, adjusted.quality.cofactors.layout
    by_station = adjusted.solution.state.rig_from_cam.inverse().adjoint()
    out = np.zeros((layout.size, 6 * len(block.image_ids)))
    for image, (station, mounting) in enumerate(zip(block.station, block.mounting, strict=True)):
        here = slice(6 * image, 6 * image + 6)
        out[6 * station : 6 * station + 6, here] = by_station[mounting].T
        if layout.mounting[mounting] >= 0:
            first = 6 * layout.stations + layout.mounting[mounting]
            out[first : first + 6, here] = np.eye(6)
    return out
