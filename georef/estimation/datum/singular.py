"""Networks that their observations and constraints do not determine: which constraint is missing.

Image observations see no motion of the whole network (three translations, three rotations, a change of scale), and
none of a rig frame against all its cameras. What the reduced normal matrix N says about such motions is therefore what
the constraints say: G' N G of candidate motions G is their information, unknowns of the border free to follow. Motions
that it leaves open name what is missing (Grafarend 1974 on the datum of networks; Triggs et al. 2000, section 9, on
gauge freedom).
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.sparse import block_array, bsr_array, coo_array, csc_array, csr_array, diags_array, eye_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from georef.estimation.adjustment.block import Block, Indices, State
from georef.estimation.adjustment.equations.reduced import Reduced
from georef.estimation.datum import singular_words as words
from georef.geometry.rigid import Array

_LOOSE = (1e3, 0.2, 0.2)
"""A motion is open if its sigma is above this: translation m, rotation rad, scale as a factor."""
_LOOSE_UNKNOWN = 1e3  # of the border: m, rad, and steps of cameras
_ROUNDING = 1e-13  # of what cancels in G' N G
_SINGULAR = 1e-12  # least eigenvalue of N with unit diagonal
_DENSE = 1500  # unknowns up to which eigenvalues are computed all at once
_STILL, _TAKES_PART, _ITERATIONS = 1e-9, 0.05, 20


def explain_singular(block: Block, state: State, reduced: Reduced, *, thorough: bool = True) -> str | None:
    """What a network lacks for a unique solution at a state, in plain words with a remedy; None where nothing.

    reduced: normal equations without damping. thorough: look for combinations of unknowns beyond motions of the whole
    network as well, which needs a factorisation of it.
    """
    network = _Network(block, state, reduced)
    found = network.unobserved() or network.loose_parts() or network.loose_rigs() or network.loose_border()
    return found or (network.other() if thorough else None)


class _Network:
    def __init__(self, block: Block, state: State, reduced: Reduced) -> None:
        self._block, self._state, self._layout, self._reduced = block, state, reduced.layout, reduced
        self._stations = _stations_matrix(reduced)
        self._diagonal = np.concatenate([self._stations.diagonal(), np.diag(reduced.corner)])
        self._edge = 6 * self._layout.stations  # where the border begins

    def _times(self, vectors: Array) -> Array:
        """N @ vectors (n, k)."""
        above, below, border = vectors[: self._edge], vectors[self._edge :], self._reduced.border
        return np.concatenate(
            [self._stations @ above + border @ below, border.T @ above + self._reduced.corner @ below]
        )

    # --- unknowns that nothing observes ---

    def unobserved(self) -> str | None:
        blind = self._diagonal <= 0.0
        stations = np.flatnonzero(blind[: self._edge].reshape(-1, 6).any(axis=1))
        if len(stations):
            return words.unseen_stations(self._block, stations)
        return words.unobserved_unknown(self._block, self._layout, int(np.argmax(blind))) if blind.any() else None

    # --- motions of whole parts ---

    def loose_parts(self) -> str | None:
        for parts in (self._parts(), self._parts_by_images()):
            loose = [self._loose(stations) for stations in parts]
            worst = max(loose, key=lambda part: part.open.shape[1])
            if worst.open.shape[1]:
                return words.missing_datum(self._block, worst, whole=len(parts) == 1)
        return None

    def _loose(self, stations: Indices) -> words.Part:
        motion, centre = self._motions_of(stations)
        return words.Part(stations, centre, self._open(motion, np.repeat(_LOOSE, (3, 3, 1)), follow=True))

    def _parts_by_images(self) -> list[Indices]:
        """Stations that see the same points: measured motions between them do not carry the scale over."""
        count, obs = self._layout.stations, self._block.observations
        station = self._block.station[obs.view]
        members = _tied(station, count + obs.point, count + len(self._block.points))
        return [part[part < count] for part in members if part[0] < count]

    def _parts(self) -> list[Indices]:
        """Stations by what ties them together, kept points included."""
        count, reduced, distances = self._layout.stations, self._reduced, self._block.distances
        row = np.repeat(np.arange(count), np.diff(reduced.first))
        tied = np.abs(reduced.block).max(axis=(1, 2), initial=0.0) > 0.0
        kept = np.flatnonzero(self._layout.kept_point >= 0)
        by_unknown = np.abs(reduced.border.reshape(count, 6, self._layout.border)).max(axis=1, initial=0.0)
        station, point = np.nonzero(by_unknown[:, self._layout.kept_point[kept]])
        node = np.zeros(len(self._block.points), np.int64)
        node[kept] = count + np.arange(len(kept))
        a = np.concatenate([row[tied], station, node[distances.a]])
        b = np.concatenate([reduced.column[tied], count + point, node[distances.b]])
        return [members[members < count] for members in _tied(a, b, count + len(kept)) if members[0] < count]

    def _motions_of(self, stations: Indices) -> tuple[Array, Array]:
        """Motions (n, 7) of stations and kept points about the stations' centre (3,): translations, turns, growth."""
        poses = self._state.world_from_rig.take(stations)
        turned, centre = np.swapaxes(poses.rotation, 1, 2), poses.translation.mean(axis=0)
        kept = np.flatnonzero(self._layout.kept_point >= 0)
        offset, of_points = poses.translation - centre, self._state.points[kept] - centre
        at, at_points = (
            6 * stations[:, None] + np.arange(6),
            self._edge + self._layout.kept_point[kept][:, None] + np.arange(3),
        )
        out = np.zeros((self._layout.size, 7))
        for axis, e in enumerate(np.eye(3)):
            for column, spin, moved, points in (
                (axis, 0.0 * e, e + 0.0 * offset, e + 0.0 * of_points),
                (3 + axis, e, np.cross(e, offset), np.cross(e, of_points)),
            ):
                by_station = [np.broadcast_to(spin, offset.shape), moved]
                out[at, column] = np.concatenate([np.einsum("nij,nj->ni", turned, v) for v in by_station], axis=1)
                out[at_points, column] = points
        out[at[:, 3:], 6] = np.einsum("nij,nj->ni", turned, offset) + self._mean_mounting[stations]
        out[at_points, 6] = of_points
        return out, centre

    @cached_property
    def _mean_mounting(self) -> Array:
        """Mean camera of each station in its rig (S, 3): what images see grow is the distances of cameras."""
        station, shift = self._block.station, self._state.rig_from_cam.translation[self._block.mounting]
        count = np.maximum(np.bincount(station, minlength=self._layout.stations), 1)
        sums = [np.bincount(station, column, minlength=self._layout.stations) for column in shift.T]
        return np.stack(sums, axis=1) / count[:, None]

    def _open(self, motions: Array, loose: Array, *, follow: bool) -> Array:
        """Basis (m, k) of combinations of motions (n, m) that nothing fixes. loose: sigmas (m,) above which a motion
        is open. follow: where rig frames and the border may follow."""
        used = np.linalg.norm(motions, axis=0) > _STILL
        product = self._times(motions[:, used])
        information = motions[:, used].T @ product
        if follow:
            cross = np.concatenate([product.T @ self._rig_frames, product[self._edge :].T], axis=1)
            information = information - cross @ self._given_way @ cross.T
        noise = _ROUNDING * np.einsum("nk,n,nk->k", motions, self._diagonal, motions)[used]
        found = _open_directions(information, loose[used], noise)
        out = np.zeros((len(used), found.shape[1]))
        out[used] = found
        return out

    @cached_property
    def _rig_frames(self) -> Array:
        """Motions (n, r) of all rig frames that nothing holds."""
        return np.concatenate([np.zeros((self._layout.size, 0)), *(motion for _, motion in self._free_rigs)], axis=1)

    @cached_property
    def _given_way(self) -> Array:
        """Pseudo-inverse of the information of rig frames and the border (r + B, r + B), stations held otherwise."""
        frames, corner = self._rig_frames, self._reduced.corner
        product = self._times(frames)
        information = np.block([[frames.T @ product, product[self._edge :].T], [product[self._edge :], corner]])
        noise = _ROUNDING * np.concatenate(
            [np.einsum("nk,n,nk->k", frames, self._diagonal, frames), self._diagonal[self._edge :]]
        )
        scale = 1.0 / np.sqrt(np.maximum(_LOOSE_UNKNOWN**-2, noise))
        inverse = np.linalg.pinv(information * scale * scale[:, None], rcond=_ROUNDING, hermitian=True)
        return np.asarray(inverse * scale * scale[:, None], dtype=np.float64)

    # --- rig frames and single unknowns of the border ---

    @cached_property
    def _free_rigs(self) -> list[tuple[Indices, Array]]:
        """Mountings of each rig none of whose cameras is held, and motions (n, 6) of its frame against all of them."""
        block, count, out = self._block, self._layout.stations, []
        for members in _tied(block.station, count + block.mounting, count + len(block.mountings)):
            rig = members[members >= count] - count
            if not len(rig) or (self._layout.mounting[rig] < 0).any():
                continue
            motion = np.zeros((self._layout.size, 6))
            for axis in range(6):
                motion[6 * members[members < count] + axis, axis] = -1.0
            for i in rig:
                start = self._edge + self._layout.mounting[i]
                motion[start : start + 6] = self._state.rig_from_cam[int(i)].inverse().adjoint()
            out.append((rig, motion))
        return out

    def loose_rigs(self) -> str | None:
        for rig, motion in self._free_rigs:
            if self._open(motion, np.repeat(_LOOSE[1::-1], 3), follow=False).shape[1]:
                return words.loose_rig([self._block.mountings[i].name for i in rig])
        return None

    def loose_border(self) -> str | None:
        noise = np.asarray(_ROUNDING * self._diagonal[self._edge :], dtype=np.float64)
        found = _open_directions(self._reduced.corner, np.full(self._layout.border, _LOOSE_UNKNOWN), noise)
        if not found.shape[1]:
            return None
        return words.unobserved_unknown(self._block, self._layout, self._edge + int(np.argmax(np.abs(found[:, 0]))))

    # --- all else ---

    def other(self) -> str | None:
        """The weakest combination of all unknowns, if the matrix is singular to working precision."""
        value, vector = self._weakest()
        if value > _SINGULAR:
            return None
        share = np.square(vector[: self._edge]).reshape(-1, 6).sum(axis=1)
        if share.sum() < 0.5:
            return words.unobserved_unknown(
                self._block, self._layout, self._edge + int(np.argmax(np.abs(vector[self._edge :])))
            )
        return words.loose_stations(self._block, np.flatnonzero(share > _TAKES_PART * share.max()))

    def _weakest(self) -> tuple[float, Array]:
        """Least eigenvalue of N with unit diagonal, and its vector (n,) in units of the diagonal."""
        scale = 1.0 / np.sqrt(self._diagonal)
        if self._layout.size <= _DENSE:
            values, vectors = np.linalg.eigh(self._reduced.dense() * scale * scale[:, None])
        else:
            border, corner = coo_array(self._reduced.border), coo_array(self._reduced.corner)
            whole = block_array([[self._stations, border], [border.T, corner]], format="csc")
            return _least(csc_array(diags_array(scale) @ whole @ diags_array(scale)), self._layout.size)
        return float(values[0]), vectors[:, 0]


def _least(matrix: csc_array, size: int) -> tuple[float, Array]:
    """Least eigenvalue of a symmetric matrix (size, size) with unit diagonal, and its vector, by inverse iteration:
    exact where it is far below the others, which is all that matters here."""
    factor = splu(csc_array(matrix + _SINGULAR * eye_array(size)))
    vector = np.random.default_rng(0).normal(size=size)
    for _ in range(_ITERATIONS):
        vector = factor.solve(vector)
        vector /= np.linalg.norm(vector)
    return float(vector @ (matrix @ vector)), vector


def _open_directions(information: Array, loose: Array, noise: Array) -> Array:
    """Basis (m, k) of directions whose information (m, m) is below what a sigma of loose (m,), or rounding, leaves."""
    scale = 1.0 / np.sqrt(np.maximum(loose**-2, noise))
    scaled = information * scale * scale[:, None]
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T))
    return scale[:, None] * vectors[:, values < 1.0]


def _stations_matrix(reduced: Reduced) -> csr_array:
    """The stations' part (6 S, 6 S), both triangles."""
    count = reduced.layout.stations
    shape = (6 * count, 6 * count)
    upper = bsr_array((reduced.block, reduced.column, reduced.first), shape=shape).tocsr()
    row = np.repeat(np.arange(count), np.diff(reduced.first))
    off = (row != reduced.column)[:, None, None] * reduced.block
    return csr_array(upper + bsr_array((off, reduced.column, reduced.first), shape=shape).T.tocsr())


def _tied(a: Indices, b: Indices, count: int) -> list[Indices]:
    """Nodes by connected components of a graph with edges a-b; each component's first member is its least."""
    _, label = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False)
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
