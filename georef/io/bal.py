"""Problem files of "Bundle Adjustment in the Large" (Agarwal, Snavely, Seitz, Szeliski, ECCV 2010).

A first row with the numbers of cameras, points and observations; a row `camera point x y` an observation, in pixels
from the image centre, x right and y up; then nine values a camera (rotation vector and translation of camera from
world, f, k1, k2) and three a point. The camera looks along -z with y up: p = -(x/z, y/z) of the point in its frame,
pixel = f (1 + k1 |p|^2 + k2 |p|^4) p. A file may be compressed (.gz, .bz2).
"""

from __future__ import annotations

import bz2
import gzip
import io
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from georef.errors import InputError
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses, exp_so3, log_so3s
from georef.geometry.rigid import Array
from georef.io.files import write_bytes_atomically

_FLIP = np.diag([1.0, -1.0, -1.0])  # camera of the house (y down, z forward) from BAL's, and back
_OPENERS = {".gz": gzip.open, ".bz2": bz2.open}


@dataclass(frozen=True, eq=False)
class BalProblem:
    """C cameras, P points, n observations as a file has them."""

    camera: NDArray[np.int64]  # (n,)
    point: NDArray[np.int64]  # (n,)
    xy: Array  # (n, 2) px from the image centre, right, up
    cameras: Array  # (C, 9)
    points: Array  # (P, 3)

    @property
    def world_from_cam(self) -> Poses:
        """C poses with the camera frame of the house."""
        cam_from_world = Poses(_FLIP @ exp_so3(self.cameras[:, :3]), self.cameras[:, 3:6] @ _FLIP)
        return cam_from_world.inverse()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height (px) of an image about the centre that holds all observations; the file says none."""
        extent = np.abs(self.xy).max(axis=0, initial=0.0)
        width, height = (2 * (int(np.ceil(v)) + 1) for v in extent)
        return width, height

    @property
    def pixels(self) -> Array:
        """Observations (n, 2) in pixels of the house, in an image of `size`."""
        width, height = self.size
        return np.stack([width / 2.0 + self.xy[:, 0], height / 2.0 - self.xy[:, 1]], axis=1)

    def house_cameras(self) -> tuple[Camera, ...]:
        """C cameras of model brown whose focal length, k1 and k2 are to be estimated, principal point held."""
        width, height = self.size
        return tuple(
            Camera(
                str(i),
                *(width, height, f, f, width / 2.0, height / 2.0),
                distortion=(k1, k2, 0.0, 0.0),
                model="brown",
                estimate=("focal", "k1", "k2"),
            )
            for i, (f, k1, k2) in enumerate(self.cameras[:, 6:].tolist())
        )

    def with_values(self, world_from_cam: Poses, cameras: tuple[Camera, ...], points: Array) -> BalProblem:
        """The same observations with other values, to be written."""
        inverse = world_from_cam.inverse()
        interior = np.array([(c.fx, *c.coefficients[:2]) for c in cameras]).reshape(-1, 3)
        rows = np.concatenate([log_so3s(_FLIP @ inverse.rotation), inverse.translation @ _FLIP, interior], axis=1)
        return BalProblem(self.camera, self.point, self.xy, rows, points)


def read_bal(path: Path | str) -> BalProblem:
    """Reads a problem. Raises InputError for text that is no such problem, values and indices that cannot be."""
    path = Path(path)
    text = _text(path)
    head, _, body = text.partition("\n")
    try:
        cameras, points, observations = (int(word) for word in head.split())
    except ValueError:
        raise _error(f"The first row is {head.strip()[:60]!r}.", path, row=1) from None
    values = _numbers(body, path)
    wanted = 4 * observations + 9 * cameras + 3 * points
    if len(values) != wanted or min(cameras, points, observations) < 0:
        problem = f"The file holds {len(values)} values after its first row, which announces {wanted}."
        raise _error(problem, path)
    table = values[: 4 * observations].reshape(-1, 4)
    index = table[:, :2].astype(np.int64)
    wrong = np.flatnonzero(((index != table[:, :2]) | (index < 0) | (index >= [cameras, points])).any(axis=1))
    if len(wrong):
        raise _error(
            f"Observation {wrong[0]} is of camera {table[wrong[0], 0]:g} and point {table[wrong[0], 1]:g}; "
            f"there are {cameras} and {points}, counted from 0.",
            path,
        )
    rest = values[4 * observations :]
    return BalProblem(
        *(index[:, 0].copy(), index[:, 1].copy(), table[:, 2:].copy()),
        rest[: 9 * cameras].reshape(-1, 9).copy(),
        rest[9 * cameras :].reshape(-1, 3).copy(),
    )


def write_bal(problem: BalProblem, path: Path | str) -> None:
    """Writes a problem with all digits; compressed where the name ends so."""
    path, out = Path(path), io.StringIO()
    out.write(f"{len(problem.cameras)} {len(problem.points)} {len(problem.camera)}\n")
    for camera, point, (x, y) in zip(problem.camera, problem.point, problem.xy.tolist(), strict=True):
        out.write(f"{camera} {point} {x!r} {y!r}\n")
    for value in [*problem.cameras.ravel().tolist(), *problem.points.ravel().tolist()]:
        out.write(f"{value!r}\n")
    data = out.getvalue().encode("ascii")
    packers = {".gz": gzip.compress, ".bz2": bz2.compress}
    write_bytes_atomically(packers[path.suffix](data) if path.suffix in packers else data, path)


def _text(path: Path) -> str:
    try:
        with _OPENERS.get(path.suffix, open)(path, "rb") as stream:
            return stream.read().decode("ascii")
    except FileNotFoundError:
        raise InputError("The file does not exist.", remedy="Correct its name.", path=path) from None
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise InputError(f"The file cannot be read: {error}.", remedy="Fetch it again.", path=path) from None


def _numbers(body: str, path: Path) -> Array:
    """All numbers of a text, separated by any blanks."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # text that it cannot read
        try:
            values = np.fromstring(body, dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError):
            values = np.array([np.nan])
    if np.isfinite(values).all():
        return values
    for row, line in enumerate(body.split("\n"), start=2):
        for word in line.split():
            try:
                finite = np.isfinite(float(word))
            except ValueError:
                finite = False
            if not finite:
                raise _error(f"{word!r} is not a finite number.", path, row=row)
    raise _error("The numbers cannot be read.", path)


def _error(problem: str, path: Path, row: int | None = None) -> InputError:
    return InputError(
        problem,
        expected="a problem of Bundle Adjustment in the Large: numbers of cameras, points and observations, then rows "
        "`camera point x y`, nine values a camera and three a point.",
        remedy="Fetch or write the file again.",
        path=path,
        row=row,
    )
