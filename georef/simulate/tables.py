"""Tables of a simulated survey, written as georef reads them: EPSG:25832, ellipsoidal heights, omega-phi-kappa."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from georef.crs import WorldFrame
from georef.geometry.angles import heading_of, omega_phi_kappa_from_rotation
from georef.geometry.camera import Camera
from georef.geometry.rigid import Array, Rigid3
from georef.simulate.lenses import Lens
from georef.simulate.survey import SurveyedPoint, SurveyMark, TiePoint
from georef.simulate.trajectory import Measured
from georef.simulate.world import WorldImage

_CRS_LINE = "# CRS: EPSG:25832, height: ellipsoidal GRS80, metres."
_SIGMAS = " 1-sigma columns in metres."
_ANGLES = " Angles: degrees, R = Rx(omega) Ry(phi) Rz(kappa), image (right, top, back) to grid (E, N, up)."
PIXELS = "# Pixels; the top-left pixel's centre is (0.5, 0.5)."


def table(comment: str, header: str, rows: Sequence[Sequence[object]]) -> str:
    return "\n".join([comment, header, *(",".join(map(str, row)) for row in rows)]) + "\n"


def camera_table(cameras: Sequence[Camera]) -> str:
    rows = [
        (c.camera_id, c.width, c.height, *(f"{v:.4f}" for v in (c.fx, c.fy, c.cx, c.cy)), *_distortion(c))
        for c in cameras
    ]
    return table(PIXELS, "camera,width,height,fx,fy,cx,cy,k1,k2,p1,p2", rows)


def _distortion(camera: Camera) -> tuple[float, ...]:
    return camera.distortion or (0.0, 0.0, 0.0, 0.0)


def orientation_table(
    poses: Mapping[str, Rigid3],
    lenses: Mapping[str, Lens],
    frame: WorldFrame,
    cameras: Mapping[str, str] | None = None,
) -> str:
    """Exterior orientation, with the interior one of images whose lens (by image id) is a pinhole, or camera ids."""
    positions = frame.crs_from_world(np.array([pose.translation for pose in poses.values()]))
    turns = frame.crs_axes_from_world(positions)
    rows = []
    for (name, pose), position, turn in zip(poses.items(), positions, turns, strict=True):
        angles = np.degrees(omega_phi_kappa_from_rotation(turn @ pose.rotation))
        intrinsics = [f"{v:.4f}" for v in _intrinsics(lenses[name])] if lenses else []
        camera = [cameras[name]] if cameras else []
        rows.append((name, *coordinates(position), *(f"{v:.8f}" for v in angles), *intrinsics, *camera))
    header = "image,easting,northing,height,omega,phi,kappa" + (",fx,fy,cx,cy" if lenses else "")
    header += ",camera" if cameras else ""
    return table(_CRS_LINE + _ANGLES, header, rows)


def _intrinsics(lens: Lens) -> tuple[float, float, float, float]:
    assert lens.camera is not None
    assert not lens.camera.distortion, "a distorted camera does not fit into columns fx, fy, cx, cy"
    return lens.camera.fx, lens.camera.fy, lens.camera.cx, lens.camera.cy


def coordinates(position: Array) -> list[str]:
    return [f"{value:.5f}" for value in position]


def _heading(heading_deg: float) -> str:
    """Empty for an image that looks up or down: it has no heading."""
    return "" if np.isnan(heading_deg) else f"{heading_deg:.2f}"


def gnss_table(images: Sequence[WorldImage], measured: Measured, frame: WorldFrame) -> str:
    """Measured positions of the projection centres, reduced by the lever arms, and headings of the optical axes."""
    poses = [measured.world_from_rigs[image.station] @ image.head.rig_from_cam for image in images]
    positions = frame.crs_from_world(np.array([pose.translation for pose in poses]))
    rows = []
    for image, pose, position in zip(images, poses, positions, strict=True):
        heading = np.degrees(heading_of(pose.rotation)) % 360.0
        sigmas = (f"{v:.3f}" for v in measured.sigma_m[image.station])
        rows.append((image.image_id, *(f"{v:.3f}" for v in position), *sigmas, _heading(heading)))
    header = "image,easting,northing,height,sigma_e,sigma_n,sigma_h,heading_deg"
    return table(_CRS_LINE + _SIGMAS + " Headings: degrees clockwise from true north.", header, rows)


def position_table(
    positions_in_world: Mapping[str, Array],
    sigmas_m: Sequence[float],
    headings_deg: Sequence[float],
    cameras: Mapping[str, str],
    frame: WorldFrame,
    stations: Mapping[str, str] | None = None,
) -> str:
    """Positions of images with one sigma for all, headings, and camera and station ids where there are any."""
    positions = frame.crs_from_world(np.array(list(positions_in_world.values())))
    rows = []
    for name, position, heading in zip(positions_in_world, positions, headings_deg, strict=True):
        named = [names[name] for names in (cameras, stations) if names]
        rows.append((name, *(f"{v:.3f}" for v in (*position, *sigmas_m)), _heading(heading), *named))
    header = "image,easting,northing,height,sigma_e,sigma_n,sigma_h,heading_deg" + (",camera" if cameras else "")
    header += ",station" if stations else ""
    return table(_CRS_LINE + _SIGMAS + " Headings: degrees clockwise from true north.", header, rows)


def point_table(points: Sequence[SurveyedPoint], frame: WorldFrame) -> str:
    positions = frame.crs_from_world(np.array([point.given for point in points]).reshape(-1, 3))
    rows = [
        (p.point_id, p.role, *(f"{v:.4f}" for v in position), *[f"{p.sigma_m:g}"] * 3, p.kind.value)
        for p, position in zip(points, positions, strict=True)
    ]
    header = "point,role,easting,northing,height,sigma_e,sigma_n,sigma_h,kind"
    return table(_CRS_LINE + _SIGMAS, header, rows)


def mark_table(marks: Sequence[SurveyMark]) -> str:
    rows = [(m.point_id, m.image_id, f"{m.pixel[0]:.3f}", f"{m.pixel[1]:.3f}", m.sigma_px) for m in marks]
    return table(PIXELS, "point,image,x,y,sigma_px", rows)


def exact_table(positions_in_world: Mapping[str, Array], frame: WorldFrame) -> str:
    """Exact coordinates by name."""
    positions = frame.crs_from_world(np.array(list(positions_in_world.values())).reshape(-1, 3))
    rows = [(name, *coordinates(p)) for name, p in zip(positions_in_world, positions, strict=True)]
    return table(_CRS_LINE, "point,easting,northing,height", rows)


def tie_table(ties: Sequence[TiePoint]) -> str:
    """Exact pixels of tie points in all images."""
    rows = [(t.point_id, name, f"{x:.4f}", f"{y:.4f}") for t in ties for name, (x, y) in t.pixels.items()]
    return table(PIXELS, "point,image,x,y", rows)
