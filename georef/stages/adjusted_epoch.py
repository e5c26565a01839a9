"""The published result of an adjustment, as it is stored."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.errors import StageError
from georef.estimation.adjustment.adjust_block import AdjustedBlock
from georef.estimation.adjustment.quality.image_covariances import image_covariances
from georef.geometry.rigid import Array, Rigid3
from georef.io.items import read_item, write_item
from georef.stages.adjustment_report import scene_points

RESULT = "adjusted.npz"
_FEW_IMAGES = 200  # whose joint covariance is stored whole


@dataclass(frozen=True, eq=False)
class AdjustedEpoch:
    """Poses and points of an epoch; covariances of all M images, and jointly of the k that
    check points are marked in (of all where they are few)."""

    image_ids: tuple[str, ...]
    world_from_cams: tuple[Rigid3, ...]
    covs: Array  # (M, 6, 6)
    joint_images: NDArray[np.int64]  # (k,) rising
    joint_cov: Array  # (6 k, 6 k)
    relative_joint_cov: Array  # (6 k, 6 k) against the reference as it is published: without its own errors
    points: Array  # (P, 3) automatic GCPs and tie points
    colors_rgb: Array  # (P, 3)
    data: dict[str, Any]
    folder: Path

    def cov(self, index: int) -> Array:
        return self.covs[index]

    def joint(self, indices: list[int]) -> Array:
        """Joint covariance (6k, 6k) of some images. Raises StageError where it was not stored."""
        return self._blocks(self.joint_cov, indices)

    def relative_joint(self, indices: list[int]) -> Array:
        """The same without the errors of the reference."""
        return self._blocks(self.relative_joint_cov, indices)

    def _blocks(self, joint: Array, indices: list[int]) -> Array:
        places = np.searchsorted(self.joint_images, indices)
        missing = [i for i in indices if i not in self.joint_images]
        if missing:
            raise StageError(
                f"Joint covariances with image '{self.image_ids[missing[0]]}' are not stored: nothing was marked in it "
                "when the epoch was adjusted.",
                "Delete the folder and run again, so that check points which were marked since then are known.",
                f"In {self.folder}.",
            )
        rows = (6 * places[:, None] + np.arange(6)).ravel()
        return joint[np.ix_(rows, rows)]


def write_adjusted(
    folder: Path, adjusted: AdjustedBlock, marked: set[str], colors_rgb: NDArray[np.uint8], data: dict[str, Any]
) -> None:
    """Stores an adjustment; marked: images whose covariances are wanted jointly; colors_rgb (P, 3): of all points."""
    header = {"image_ids": list(adjusted.block.image_ids), "data": data}
    write_item(folder / RESULT, header, _arrays(adjusted, marked, colors_rgb[scene_points(adjusted)]))


def write_nothing(folder: Path) -> None:
    """Stores that there was nothing to adjust."""
    write_item(folder / RESULT, {"image_ids": [], "data": {}}, _nothing())


def read_adjusted(folder: Path) -> AdjustedEpoch:
    """The stored result of this stage."""
    header, arrays = read_item(folder / RESULT)
    return AdjustedEpoch(
        image_ids=tuple(header["image_ids"]),
        world_from_cams=tuple(Rigid3.from_matrix(m) for m in arrays["poses"]),
        covs=arrays["covs"],
        joint_images=arrays["joint_images"],
        joint_cov=arrays["joint_cov"],
        relative_joint_cov=arrays["relative_joint_cov"],
        points=arrays["points"],
        colors_rgb=arrays["colors"],
        data=header["data"],
        folder=folder,
    )


def _arrays(adjusted: AdjustedBlock, wanted: set[str], colors: NDArray[np.uint8]) -> dict[str, np.ndarray]:
    """What is stored; wanted: images whose covariances are wanted jointly."""
    state, ids = adjusted.solution.state, adjusted.block.image_ids
    few = len(ids) <= _FEW_IMAGES
    covs = image_covariances(adjusted, np.array([i for i, name in enumerate(ids) if few or name in wanted], np.int64))
    return {
        "poses": np.array([pose.matrix() for pose in adjusted.block.world_from_cam(state).to_list()]),
        "covs": covs.own,
        "joint_images": covs.images,
        "joint_cov": covs.joint,
        "relative_joint_cov": covs.relative_joint,
        "points": state.points[scene_points(adjusted)],
        "colors": colors,
    }


def _nothing() -> dict[str, np.ndarray]:
    zero = np.zeros
    return {
        "poses": zero((0, 4, 4)),
        "covs": zero((0, 6, 6)),
        "joint_images": zero(0, np.int64),
        "joint_cov": zero((0, 0)),
        "relative_joint_cov": zero((0, 0)),
        "points": zero((0, 3)),
        "colors": zero((0, 3), np.uint8),
    }
