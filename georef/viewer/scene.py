"""What a recording shows, in the metric world frame, and how it is bounded and exaggerated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array, Rigid3
from georef.report.plan import nearest
from georef.types.campaign import Image
from georef.types.constraints import CheckPoint, ControlPoint
from georef.types.results import Rejected

MOST_PICTURES = 400  # of all images; above, only some cameras have one
_LEAST_REFERENCE_PICTURES = 100
_VECTOR_SHARE = 0.05  # of the scene's extent: length of an exaggerated residual at the 95th percentile


@dataclass(frozen=True, eq=False)
class Scene:
    """One epoch for the viewer. All positions, residuals and covariances refer to the world frame."""

    title: str
    run: str  # tells recordings of different runs apart
    reference: Sequence[tuple[Image, Rigid3]]  # with their given poses
    new: Sequence[Image]
    adjusted: Mapping[str, Rigid3]  # by image id
    localized: Mapping[str, Rigid3]  # straight after PnP
    rejected: Sequence[Rejected]
    position_covs: Mapping[str, Array]  # (3, 3) of adjusted positions
    points: Array  # (P, 3)
    colors_rgb: NDArray[Any]  # (P, 3)
    check: Sequence[CheckPoint]
    control: Sequence[ControlPoint]
    residuals: Mapping[
        str, Array
    ]  # (3,) by point id, estimated minus reference; points without one were not determined
    report: Mapping[str, Any]

    @property
    def new_centres(self) -> Array:
        return np.array([pose.translation for pose in self.adjusted.values()]).reshape(-1, 3)

    @property
    def reference_centres(self) -> Array:
        return np.array([pose.translation for _, pose in self.reference]).reshape(-1, 3)

    @property
    def focus(self) -> tuple[Array, float]:
        """The middle of what matters and its extent in metres: new cameras and points, else the reference."""
        near = [self.new_centres, self.points, *[p.point_in_world[None] for p in (*self.check, *self.control)]]
        everything = np.concatenate(near) if len(self.adjusted) else self.reference_centres
        if not len(everything):
            return np.zeros(3), 10.0
        low, high = np.quantile(everything, [0.03, 0.97], axis=0)
        return 0.5 * (low + high), max(float(np.linalg.norm(high - low)), 1.0)


def exaggeration(lengths_m: Array, extent_m: float) -> int:
    """The round factor (1, 2 or 5 times a power of ten) that makes small vectors visible in a scene."""
    longest = float(np.quantile(lengths_m, 0.95)) if len(lengths_m) else 0.0
    if longest <= 0:
        return 1
    wanted = max(_VECTOR_SHARE * extent_m / longest, 1.0)
    power = 10 ** int(np.floor(np.log10(wanted)))
    return max(m for m in (1, 2, 5) if m * power <= wanted * (1 + 1e-9)) * power


def new_with_picture(scene: Scene) -> list[Image]:
    """New images that are shown as cameras with their pictures: all that have a pose, or an even choice of them."""
    posed = [image for image in scene.new if image.image_id in scene.adjusted]
    limit = MOST_PICTURES - _LEAST_REFERENCE_PICTURES
    if len(posed) <= limit:
        return posed
    return [posed[i] for i in np.linspace(0, len(posed) - 1, limit).astype(int)]


def reference_with_picture(scene: Scene) -> NDArray[np.int64]:
    """Indices of the reference images that are shown with their pictures: all, or those nearest to new ones."""
    limit = max(MOST_PICTURES - len(scene.adjusted), _LEAST_REFERENCE_PICTURES)
    return nearest(scene.reference_centres, scene.new_centres, limit)
