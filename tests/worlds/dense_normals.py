"""All observation equations of a small block as one dense matrix: the plain way, to compare with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.equations.constraint_terms import constraint_terms, root
from georef.estimation.adjustment.equations.reduced import Layout, Reduced
from georef.geometry.camera import intrinsic_derivatives
from georef.geometry.projection import linearize
from georef.geometry.rigid import Array


@dataclass(frozen=True, eq=False)
class Equations:
    """Whitened equations: residual (n,), design (n, u); unknowns are those of the reduced system, then 3 a point.

    group: what each row belongs to: "image", a term's name, or "points"; item: which one of these.
    """

    layout: Layout
    residual: Array
    design: Array
    group: list[str]
    item: list[int]
    point: Array  # (P,) first unknown of each point

    def rows(self, group: str, item: int) -> list[int]:
        return [i for i, here in enumerate(zip(self.group, self.item, strict=True)) if here == (group, item)]

    @property
    def inverse(self) -> Array:
        """(u, u), scaled so that its condition does not suffer from units."""
        normal = self.design.T @ self.design
        scale = 1.0 / np.sqrt(np.diag(normal))
        return np.linalg.inv(normal * scale[:, None] * scale) * scale[:, None] * scale


def equations(block: Block, state: State) -> Equations:
    layout = Layout.of(block)
    kept = layout.kept_point >= 0
    point = np.where(kept, 6 * layout.stations + layout.kept_point, layout.size + 3 * (np.cumsum(~kept) - 1))
    size = layout.size + 3 * int((~kept).sum())
    rows: list[tuple[Array, Array, str, int]] = []
    _images(rows, block, state, layout, point, size)
    for term in constraint_terms(block, state, layout):
        for k in range(len(term.row)):
            design = np.zeros((term.residual.shape[1], size))
            for first, by in term.columns:
                if first[k] >= 0:
                    design[:, first[k] : first[k] + by.shape[2]] += by[k]
            rows.append((term.residual[k], design, term.name, int(term.row[k])))
    priors = block.point_priors
    for k, weight in enumerate(root(priors.information)):
        design = np.zeros((3, size))
        at = point[priors.point[k]]
        design[:, at : at + 3] = weight
        rows.append((weight @ (state.points[priors.point[k]] - priors.position[k]), design, "points", k))
    labels = [(name, item) for residual, _, name, item in rows for _ in residual]
    return Equations(
        layout,
        np.concatenate([r for r, _, _, _ in rows]),
        np.concatenate([d for _, d, _, _ in rows]),
        [name for name, _ in labels],
        [item for _, item in labels],
        point,
    )


def _images(rows: list, block: Block, state: State, layout: Layout, point: Array, size: int) -> None:  # type: ignore[type-arg]
    obs, edge = block.observations, 6 * layout.stations
    lin = linearize(block.views(state), obs.view, state.points[obs.point])
    in_cam = block.views(state).to_cam(obs.view, state.points[obs.point])
    for k in range(len(obs)):
        image, design = obs.view[k], np.zeros((2, size))
        mounting, calibration = block.mounting[image], block.calibration[image]
        station, at = 6 * block.station[image], point[obs.point[k]]
        design[:, station : station + 6] = lin.by_pose[k] @ state.rig_from_cam[int(mounting)].inverse().adjoint()
        if (first := layout.mounting[mounting]) >= 0:
            design[:, edge + first : edge + first + 6] = lin.by_pose[k]
        if (first := layout.calibration[calibration]) >= 0:
            camera = state.cameras[calibration]
            by = intrinsic_derivatives(camera, in_cam[k : k + 1], camera.estimate)[0]
            design[:, edge + first : edge + first + by.shape[1]] = by
        design[:, at : at + 3] = lin.by_point[k]
        rows.append(((lin.pixel[k] - obs.pixel[k]) / obs.sigma_px[k], design / obs.sigma_px[k], "image", k))


def reduced_of(found: Equations) -> Reduced:
    """Points eliminated from the dense normal matrix, in the sparse form; pairs that are zero are left out."""
    layout, size = found.layout, found.layout.size
    normal, gradient = found.design.T @ found.design, found.design.T @ found.residual
    across = normal[:size, size:] @ np.linalg.inv(normal[size:, size:])
    return sparse(
        layout, normal[:size, :size] - across @ normal[size:, :size], gradient[:size] - across @ gradient[size:]
    )


def sparse(layout: Layout, normal: Array, gradient: Array) -> Reduced:
    """A dense normal matrix with all station pairs in its pattern that are not zero."""
    edge, first, column, blocks = 6 * layout.stations, [0], [], []
    for i in range(layout.stations):
        for j in range(i, layout.stations):
            block = normal[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
            if i == j or np.any(block != 0):
                column.append(j)
                blocks.append(block)
        first.append(len(column))
    return Reduced(
        layout,
        np.array(first),
        np.array(column),
        np.array(blocks),
        normal[:edge, edge:].copy(),
        normal[edge:, edge:].copy(),
        gradient,
    )
