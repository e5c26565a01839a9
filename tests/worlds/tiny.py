"""A small world that is rendered when a test asks for it: two textured walls at a right angle and the ground.

Eight reference images and three new ones, 640 x 480 px, with exact poses, written as the files that a survey brings:
EPSG:25832 with ellipsoidal heights. The numbers are exact but for the noise that a survey has (SIGMA_*).
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from georef.crs import CrsDefinition, WorldFrame
from georef.geometry.angles import omega_phi_kappa_from_rotation, rotation_from_yaw_pitch_roll
from georef.geometry.camera import Camera, project
from georef.geometry.rigid import Array, Rigid3

Image = NDArray[np.uint8]

ORIGIN = (456580.0, 5421025.0, 170.0)
CAMERA = Camera("cam", 640, 480, 560.0, 560.0, 322.0, 238.0)
EPOCH = "second"
SIGMA_GNSS_M = (0.5, 0.5, 1.0)
SIGMA_REFERENCE_M, SIGMA_REFERENCE_DEG = 0.002, 0.004
SIGMA_POINT_M, SIGMA_MARK_PX = 0.003, 0.2
_PX_PER_M = 80.0
_CRS_LINE = "# CRS: EPSG:25832, height: ellipsoidal, metres."
_ANGLES_LINE = " Angles: degrees, R = Rx(omega) Ry(phi) Rz(kappa), image (right, top, back) to grid (E, N, up)."

PROJECT_TOML = f"""\
name = "tiny"
preset = "sift"

[crs]
horizontal = "EPSG:25832"
height = "ellipsoidal"
origin = {list(ORIGIN)}

[reference]
images = "reference"
cameras = "camera.csv"
exterior_orientation = "reference_eo.csv"
angles = "omega-phi-kappa"
angle_unit = "deg"
sigma = {{ position_m = {[SIGMA_REFERENCE_M] * 3}, rotation_deg = {[SIGMA_REFERENCE_DEG] * 3} }}

[epochs.{EPOCH}]
images = "{EPOCH}"
cameras = "camera.csv"
gnss = "{EPOCH}_gnss.csv"

[points]
coordinates = "points.csv"
marks = {{ {EPOCH} = "marks_{EPOCH}.csv" }}
check_kind = "absolute"

[config.features]
max_keypoints = 700

[config.candidates]
count = 6

[config.report]
recording = false
"""


@dataclass(frozen=True, eq=False)
class Wall:
    """A textured rectangle: `corner` is the world point of the texture's top left, `right` and `down` unit vectors."""

    corner: Array
    right: Array
    down: Array
    size_m: tuple[float, float]
    seed: int

    def pixels_from_texture(self, world_from_cam: Rigid3) -> Array:
        """Homography (3, 3) from metres on the wall to pixels."""
        cam_from_world = world_from_cam.inverse()
        columns = np.column_stack([self.right, self.down, self.corner - world_from_cam.translation])
        return CAMERA.matrix @ cam_from_world.rotation @ columns

    def at(self, across_m: float, down_m: float) -> Array:
        return self.corner + across_m * self.right + down_m * self.down


_UP = np.array([0.0, 0.0, 1.0])
_EAST, _NORTH = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
GROUND = Wall(np.array([-16.0, 12.0, 0.0]), _EAST, -_NORTH, (26.0, 26.0), 3)
NORTH_WALL = Wall(np.array([-16.0, 12.0, 9.0]), _EAST, -_UP, (26.0, 9.0), 1)
EAST_WALL = Wall(np.array([10.0, 12.0, 9.0]), -_NORTH, -_UP, (26.0, 9.0), 2)
WALLS = (GROUND, NORTH_WALL, EAST_WALL)


@dataclass(frozen=True, eq=False)
class TinyWorld:
    """Where the files lie, and the truth."""

    data: Path
    truth: dict[str, Rigid3]  # world_from_cam of the new images
    frame: WorldFrame


def write_tiny_world(folder: Path, *, rendered: bool = True, more: int = 0, local: bool = False) -> TinyWorld:
    """Writes all images, tables and project.toml into a folder, the same on every run.

    rendered = False leaves the image files empty, which is enough for everything that reads tables alone. more: new
    images beyond the three. local: coordinates of an engineering CRS, which are those of the world.
    """
    rng = np.random.default_rng(7)
    definition = CrsDefinition("local", None) if local else CrsDefinition("EPSG:25832", "ellipsoidal")
    frame = WorldFrame.create(definition, (0.0, 0.0, 0.0) if local else ORIGIN)
    reference = {f"r{i}.jpg": pose for i, pose in enumerate(_reference_poses())}
    new = {f"n{i}.jpg": pose for i, pose in enumerate([*_new_poses(), *_more_poses(more)])}
    textures = wall_textures() if rendered else []
    for name, poses in (("reference", reference), (EPOCH, new)):
        (folder / name).mkdir(parents=True, exist_ok=True)
        for image_id, pose in poses.items():
            path = folder / name / image_id
            if rendered:
                save_image(path, render(pose, textures, image_id))
            else:
                path.touch()
    (folder / "project.toml").write_text(PROJECT_TOML, encoding="utf-8")
    _write_camera(folder / "camera.csv")
    _write_orientation(folder / "reference_eo.csv", _disturbed(reference, rng), frame)
    _write_orientation(folder / f"truth_{EPOCH}_eo.csv", new, frame)
    _write_gnss(folder / f"{EPOCH}_gnss.csv", new, frame, rng)
    _write_points(folder, new, frame, rng)
    if local:
        _make_local(folder)
    return TinyWorld(folder, new, frame)


def wall_textures(seed: int = 0) -> list[Image]:
    """One texture a wall; another seed makes another place of the same shape."""
    return [texture(*wall.size_m, wall.seed + 100 * seed) for wall in WALLS]


def texture(width_m: float, height_m: float, seed: int) -> Image:
    """Seeded noise at several scales, in colour: corners and blobs of every size, nothing twice."""
    rng = np.random.default_rng(seed)
    size = (round(width_m * _PX_PER_M), round(height_m * _PX_PER_M))
    out = np.zeros((size[1], size[0], 3))
    for cell in (2, 5, 12, 30, 80):
        coarse = rng.normal(0, 1, (size[1] // cell + 2, size[0] // cell + 2, 3)).astype(np.float32)
        out += cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC) * (0.35 if cell == 2 else 1.0)
    return np.clip(128 + 32 * out, 0, 255).astype(np.uint8)


def render(world_from_cam: Rigid3, textures: list[Image], image_id: str) -> Image:
    """What the camera sees of the walls, with a little noise of its own; the sky is plain."""
    rng = np.random.default_rng(zlib.crc32(image_id.encode()))
    size = (CAMERA.width, CAMERA.height)
    out = np.full((CAMERA.height, CAMERA.width, 3), 200, np.uint8)
    metres_from_texture = np.array(
        [[1 / _PX_PER_M, 0, 0.5 / _PX_PER_M], [0, 1 / _PX_PER_M, 0.5 / _PX_PER_M], [0, 0, 1]]
    )
    index_from_pixels = np.array([[1.0, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # OpenCV counts from the pixel's centre
    for wall, image in zip(WALLS, textures, strict=True):
        homography = index_from_pixels @ wall.pixels_from_texture(world_from_cam) @ metres_from_texture
        seen = cv2.warpPerspective(image, homography, size, flags=cv2.INTER_LINEAR)
        inside = cv2.warpPerspective(np.full(image.shape[:2], 255, np.uint8), homography, size)
        visible = (np.asarray(inside) > 127) & _in_front(homography)
        out[visible] = seen[visible]
    noisy = out + rng.normal(0, 2.0, out.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def save_image(path: Path, image_rgb: Image) -> None:
    cv2.imwrite(str(path), cv2.cvtColor(image_rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 95])


def camera_row(camera: Camera = CAMERA) -> str:
    return f"{camera.camera_id},{camera.width},{camera.height},{camera.fx},{camera.fy},{camera.cx},{camera.cy}"


def _in_front(homography: Array) -> NDArray[np.bool_]:
    """Pixels (H, W) whose ray meets the wall in front of the camera, not behind it."""
    x, y = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    back = np.linalg.inv(homography)
    inverse_depth = back[2, 0] * x + back[2, 1] * y + back[2, 2]
    return inverse_depth > 0


def _pose(x: float, y: float, z: float, yaw: float, pitch: float, roll: float = 0.0) -> Rigid3:
    return Rigid3(rotation_from_yaw_pitch_roll(np.radians([yaw, pitch, roll])), np.array([x, y, z]))


def _reference_poses() -> list[Rigid3]:
    """An arc about the corner of the walls, looking into it."""
    return [
        _pose(
            -9 + 2.2 * i, -1.5 - 0.9 * i + 0.5 * (i % 3), 3.0 + 0.8 * (i % 2), 34 + 3.0 * i, -4 - (i % 3), 2.0 * (i % 2)
        )
        for i in range(8)
    ]


def _new_poses() -> list[Rigid3]:
    return [_pose(-6.0, -2.6, 3.3, 38, -5, 1), _pose(-1.0, -4.1, 3.6, 46, -3, -1), _pose(3.8, -6.0, 3.2, 50, -6, 2)]


def _more_poses(count: int) -> list[Rigid3]:
    """A walk to and fro before the walls, looking into their corner."""
    k = np.arange(count)
    x, y = -8.0 + 14.0 * k / max(count - 1, 1), -3.0 - 0.45 * k - 1.5 * (k % 2)
    yaw = np.degrees(np.arctan2(9.0 - x, 10.0 - y)) + 4.0 * (k % 3 - 1)
    return [_pose(x[i], y[i], 3.0 + 0.2 * (i % 4), yaw[i], -4.0, 1.0) for i in k]


def _make_local(folder: Path) -> None:
    """The tables and the project of the same numbers as coordinates x, y, z of an engineering CRS."""
    for path in folder.glob("*.csv"):
        text = path.read_text(encoding="utf-8").replace(_CRS_LINE, "# Local engineering CRS of the site, metres.")
        for name, other in (
            ("easting,northing,height", "x,y,z"),
            ("sigma_e,sigma_n,sigma_h", "sigma_x,sigma_y,sigma_z"),
        ):
            text = text.replace(name, other)
        path.write_text(text, encoding="utf-8")
    lines = [
        'horizontal = "local"' if line.startswith("horizontal") else line
        for line in PROJECT_TOML.splitlines()
        if not line.startswith(("height", "origin"))
    ]
    (folder / "project.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _disturbed(poses: dict[str, Rigid3], rng: np.random.Generator) -> dict[str, Rigid3]:
    """Poses as a survey knows them."""
    sigma = np.array([np.radians(SIGMA_REFERENCE_DEG)] * 3 + [SIGMA_REFERENCE_M] * 3)
    return {name: pose @ Rigid3.exp(sigma * rng.normal(size=6)) for name, pose in poses.items()}


def _write_camera(path: Path) -> None:
    path.write_text(f"camera,width,height,fx,fy,cx,cy\n{camera_row()}\n", encoding="utf-8")


def _write_orientation(path: Path, poses: dict[str, Rigid3], frame: WorldFrame) -> None:
    positions = frame.crs_from_world(np.array([pose.translation for pose in poses.values()]))
    turns = frame.crs_axes_from_world(positions)
    rows = [_CRS_LINE + _ANGLES_LINE, "image,easting,northing,height,omega,phi,kappa"]
    for (name, pose), position, turn in zip(poses.items(), positions, turns, strict=True):
        angles = np.degrees(omega_phi_kappa_from_rotation(turn @ pose.rotation))
        rows.append(",".join([name, *(f"{v:.5f}" for v in position), *(f"{v:.8f}" for v in angles)]))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def _write_gnss(path: Path, poses: dict[str, Rigid3], frame: WorldFrame, rng: np.random.Generator) -> None:
    positions = frame.crs_from_world(np.array([pose.translation for pose in poses.values()]))
    rows = [_CRS_LINE, "image,easting,northing,height,sigma_e,sigma_n,sigma_h"]
    for name, position in zip(poses, positions, strict=True):
        measured = position + np.array(SIGMA_GNSS_M) * rng.normal(size=3)
        rows.append(",".join([name, *(f"{v:.3f}" for v in measured), *map(str, SIGMA_GNSS_M)]))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def _write_points(folder: Path, poses: dict[str, Rigid3], frame: WorldFrame, rng: np.random.Generator) -> None:
    """Points on both walls and the ground; marks wherever at least two new images see one."""
    points = {f"P{i:02d}": p for i, p in enumerate(_surveyed_points())}
    marks = {name: _marks(p, poses, rng) for name, p in points.items()}
    kept = [name for name in points if len(marks[name]) >= 2]
    positions = frame.crs_from_world(np.array([points[name] for name in kept]))
    rows = [_CRS_LINE, "point,role,easting,northing,height,sigma_e,sigma_n,sigma_h"]
    for i, (name, position) in enumerate(zip(kept, positions, strict=True)):
        measured = position + SIGMA_POINT_M * rng.normal(size=3)
        role = "control" if i % 5 == 0 else "check"
        rows.append(",".join([name, role, *(f"{v:.4f}" for v in measured), *[str(SIGMA_POINT_M)] * 3]))
    (folder / "points.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    lines = [
        f"{name},{image},{x:.3f},{y:.3f},{SIGMA_MARK_PX}" for name in kept for image, (x, y) in marks[name].items()
    ]
    header = "point,image,x,y,sigma_px"
    (folder / f"marks_{EPOCH}.csv").write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")


def _surveyed_points() -> list[Array]:
    across, down = np.meshgrid(np.arange(2.0, 26.0, 4.0), (2.0, 5.0, 8.0))
    on_wall = [wall.at(a, d) for wall in (NORTH_WALL, EAST_WALL) for a, d in zip(across.flat, down.flat, strict=True)]
    return [*on_wall, *(GROUND.at(a, d) for a in (14.0, 18.0, 22.0) for d in (6.0, 10.0))]


def _marks(point: Array, poses: dict[str, Rigid3], rng: np.random.Generator) -> dict[str, Array]:
    out = {}
    for name, pose in poses.items():
        pixel = project(CAMERA, pose.inverse().apply(point[None]))[0]
        if np.isfinite(pixel).all() and (pixel > 2).all() and (pixel < (CAMERA.width - 2, CAMERA.height - 2)).all():
            out[name] = pixel + SIGMA_MARK_PX * rng.normal(size=2)
    return out
