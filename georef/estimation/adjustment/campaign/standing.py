"""An adjustment that stands: what the next one of the same campaign begins with, once images or control are added.

Everything goes by names, since a new block numbers its stations, images and points anew: stations and images by their
ids, mountings, cameras and antennas by name, image observations by image and keypoint, marks by image and point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from georef.estimation.adjustment.adjust_block import AdjustedBlock
from georef.estimation.adjustment.block import KINDS_OF_POINT, KINDS_OF_POSE, Block, Indices, State
from georef.estimation.adjustment.blunders.gates import GATED, RejectedConstraint, name_of
from georef.estimation.adjustment.equations.constraint_terms import DISTANCES, POSITION_PRIORS, RELATIVE_POSES
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.geometry.rigid import Array

Key = tuple[str, str]  # kind and name of a constraint


@dataclass(frozen=True, eq=False)
class Standing:
    """What is kept of an adjustment. station_cov: of world_from_rig, right perturbations.

    out_image, out_keypoint, out_point: image observations that were rejected; of a mark keypoint is -1 and the point
    named. constraints: all that could be rejected, those of `rejected` among them.
    """

    station_ids: tuple[str, ...]
    image_ids: tuple[str, ...]
    world_from_rig: Poses  # S
    station_cov: Array  # (S, 6, 6)
    mountings: tuple[str, ...]
    rig_from_cam: Poses
    cameras: tuple[Camera, ...]
    antennas: tuple[str, ...]
    lever_arms_m: Array  # (A, 3)
    drift_m: Array  # (D, 3)
    out_image: Indices  # (n,) of image_ids
    out_keypoint: Indices  # (n,)
    out_point: tuple[str, ...]  # n
    constraints: frozenset[Key]
    rejected: tuple[RejectedConstraint, ...]
    coherent: frozenset[Key]  # constraints that were taken out together
    sigma_scale: float

    @staticmethod
    def of(given: Block, adjusted: AdjustedBlock) -> Standing:
        """Of a block as it was given, and its adjustment."""
        block, state = adjusted.block, adjusted.solution.state
        out = given.observations.take(~np.isin(_observed(given), _observed(block)))
        names = _point_names(given)
        every, left = constraint_keys(given), constraint_keys(block)
        pairs = zip(out.keypoint.tolist(), out.point.tolist(), strict=True)
        marked = tuple("" if keypoint >= 0 else names[point] for keypoint, point in pairs)
        single = {(r.kind, r.name) for r in adjusted.rejected}
        return Standing(
            *(given.station_ids, given.image_ids, state.world_from_rig, adjusted.quality.cofactors.stations),
            *(tuple(m.name for m in given.mountings), state.rig_from_cam, state.cameras),
            *(tuple(a.name for a in given.antennas), state.lever_arms_m, state.drift_m),
            *(out.view, out.keypoint, marked),
            *(frozenset(every), adjusted.rejected, frozenset(set(every) - set(left) - single), adjusted.sigma_scale),
        )

    def start(self, block: Block) -> State:
        """Approximate values of a block: what stands where it is known, else its own; points are its own."""
        start = block.start()
        start = replace(start, world_from_rig=start.world_from_rig.take(np.arange(len(block.station_ids))))
        old, new = _common(self.station_ids, block.station_ids)
        start.world_from_rig.rotation[new] = self.world_from_rig.rotation[old]
        start.world_from_rig.translation[new] = self.world_from_rig.translation[old]
        old, new = _common(self.mountings, tuple(m.name for m in block.mountings))
        start.rig_from_cam.rotation[new] = self.rig_from_cam.rotation[old]
        start.rig_from_cam.translation[new] = self.rig_from_cam.translation[old]
        known = {camera.camera_id: camera for camera in self.cameras}
        cameras = tuple(_continued(camera, known.get(camera.camera_id)) for camera in start.cameras)
        old, new = _common(self.antennas, tuple(a.name for a in block.antennas))
        start.lever_arms_m[new] = self.lever_arms_m[old]
        drift = self.drift_m if len(self.drift_m) == len(start.drift_m) else start.drift_m
        return replace(start, cameras=cameras, drift_m=drift)

    def passed(self, block: Block) -> NDArray[np.bool_]:
        """Which image observations of a block were not rejected before."""
        where = np.full(len(self.image_ids), -1)
        old, new = _common(self.image_ids, block.image_ids)
        where[old] = new
        ids = {name: point for point, name in _point_names(block).items()}
        named = np.array([ids.get(name, -1) for name in self.out_point], dtype=np.int64)
        image = where[self.out_image]
        out = _keys(image, self.out_keypoint, named)[(image >= 0) & ((self.out_keypoint >= 0) | (named >= 0))]
        return ~np.isin(_observed(block), out)

    def known_stations(self, block: Block) -> NDArray[np.bool_]:
        return np.isin(np.array(block.station_ids, dtype=object), np.array(self.station_ids, dtype=object))

    def known_images(self, block: Block) -> NDArray[np.bool_]:
        return np.isin(np.array(block.image_ids, dtype=object), np.array(self.image_ids, dtype=object))


def with_lasting_names(block: Block) -> Block:
    """The block with its automatic GCPs named by the first image that sees each, and the keypoint there: their numbers
    change with every image that is added."""
    obs, given = block.observations, block.point_priors
    automatic = given.kind == KINDS_OF_POINT.index("automatic")
    rank = np.empty(len(block.image_ids), np.int64)
    rank[np.argsort(np.array(block.image_ids, dtype=str), kind="stable")] = np.arange(len(rank))
    rays = np.flatnonzero(np.isin(obs.point, given.point[automatic]))
    order = rays[np.lexsort((obs.keypoint[rays], rank[obs.view[rays]], obs.point[rays]))]
    seen, first = np.unique(obs.point[order], return_index=True)
    leader = dict(zip(seen.tolist(), order[first].tolist(), strict=True))

    def name(row: int) -> str:
        at = leader.get(int(given.point[row])) if automatic[row] else None
        return given.point_ids[row] if at is None else f"{block.image_ids[obs.view[at]]}#{obs.keypoint[at]}"

    return replace(block, point_priors=replace(given, point_ids=tuple(name(row) for row in range(len(given)))))


def constraint_keys(block: Block) -> list[Key]:
    """Kind and name of every constraint that may be rejected."""
    return [(kind, name_of(block, kind, row)) for kind, row in _rows(block)]


def without_constraints(block: Block, names: set[Key] | frozenset[Key]) -> Block:
    """The block without constraints of these kinds and names."""
    drop: dict[str, set[int]] = {}
    for kind, row in _rows(block):
        if (kind, name_of(block, kind, row)) in names:
            part = "poses" if kind in KINDS_OF_POSE else "points" if kind in KINDS_OF_POINT else kind
            drop.setdefault(part, set()).add(row)

    def keep(part: str, count: int) -> NDArray[np.bool_]:
        return ~np.isin(np.arange(count), list(drop.get(part, ())))

    return replace(
        block,
        pose_priors=block.pose_priors.take(keep("poses", len(block.pose_priors))),
        point_priors=block.point_priors.take(keep("points", len(block.point_priors))),
        position_priors=block.position_priors.take(keep(POSITION_PRIORS, len(block.position_priors))),
        relative_poses=block.relative_poses.take(keep(RELATIVE_POSES, len(block.relative_poses))),
        distances=block.distances.take(keep(DISTANCES, len(block.distances))),
    )


def _rows(block: Block) -> list[tuple[str, int]]:
    kinds = [(KINDS_OF_POSE[k], i) for i, k in enumerate(block.pose_priors.kind)]
    kinds += [(KINDS_OF_POINT[k], i) for i, k in enumerate(block.point_priors.kind)]
    kinds += [(POSITION_PRIORS, i) for i in range(len(block.position_priors))]
    kinds += [(RELATIVE_POSES, i) for i in range(len(block.relative_poses))]
    kinds += [(DISTANCES, i) for i in range(len(block.distances))]
    return [(kind, row) for kind, row in kinds if kind in GATED]


def _common(old: tuple[str, ...], new: tuple[str, ...]) -> tuple[Indices, Indices]:
    """Places of names in both: in the old list, and in the new one."""
    at = {name: i for i, name in enumerate(old)}
    pairs = [(at[name], j) for j, name in enumerate(new) if name in at]
    return tuple(np.array(pairs, dtype=np.int64).reshape(-1, 2).T)  # pyright: ignore[reportReturnType]


def _continued(camera: Camera, known: Camera | None) -> Camera:
    """A camera with the values that stand, where it is the same model with the same unknowns."""
    same = known is not None and (known.model, known.estimate) == (camera.model, camera.estimate)
    return known if same and known is not None and camera.estimate else camera


def _observed(block: Block) -> Indices:
    obs = block.observations
    return _keys(obs.view, obs.keypoint, obs.point)


def _keys(image: Indices, keypoint: Indices, point: Indices) -> Indices:
    """One number for each observation: keypoints even, marks odd."""
    return (image << 34) + np.where(keypoint >= 0, keypoint << 1, (point << 1) + 1)


def _point_names(block: Block) -> dict[int, str]:
    """Names of points that have one; others by their number, which is of this block alone."""
    names = dict(zip(block.point_priors.point.tolist(), block.point_priors.point_ids, strict=True))
    marked = np.unique(block.observations.point[block.observations.keypoint < 0])
    return {int(p): f"#{p}" for p in marked} | names
