"""Check and control points of a recording, and what is drawn larger than it is: residuals, moves, sigmas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from georef.geometry.rigid import Array
from georef.types.constraints import CheckKind, CheckPoint, ControlPoint
from georef.viewer.scene import exaggeration
from georef.viewer.writer import CHECK, CONTROL, RESIDUAL, SIGMA, UNDETERMINED, Rgb, Writer

_MOST_LABELS = 80


def log_check_points(writer: Writer) -> None:
    """Each kind apart; points that were not determined are grey and have no vector."""
    scene = writer.scene
    for kind in CheckKind:
        points = [p for p in scene.check if p.kind is kind]
        _log_surveyed(writer, f"world/check_points/{kind}", points, f"{kind} check points", CHECK[kind])


def log_control_points(writer: Writer) -> None:
    used = any(p.point_id in writer.scene.residuals for p in writer.scene.control)
    what = "control points of the adjustment" if used else "control points, not used"
    _log_surveyed(writer, "world/control_points", writer.scene.control, what, CONTROL)


def _log_surveyed(
    writer: Writer,
    path: str,
    points: Sequence[CheckPoint] | Sequence[ControlPoint],
    what: str,
    color: Rgb,
) -> None:
    """Points at their reference coordinates, with exaggerated residuals."""
    if not points:
        return
    residuals = writer.scene.residuals
    positions = np.array([p.point_in_world for p in points])
    colors = [color if p.point_id in residuals or isinstance(p, ControlPoint) else UNDETERMINED for p in points]
    labels = [_point_label(p.point_id, residuals.get(p.point_id)) for p in points]
    shown = rr.Points3D(
        positions,
        colors=colors,
        labels=labels,
        show_labels=len(points) <= _MOST_LABELS,
        radii=rr.Radius.ui_points(4.0),
    )
    writer.log(f"{path}/points", shown)
    writer.legend.append((f"{path}/points", what))
    writer.into_images.append(f"/{path}/points")
    found = {p.point_id: residuals[p.point_id] for p in points if p.point_id in residuals}
    origins = {p.point_id: p.point_in_world for p in points}
    _log_vectors(writer, f"{path}/residuals", found, origins, f"residuals of the {what}", RESIDUAL)


def _point_label(name: str, residual: Array | None) -> str:
    return name if residual is None else f"{name}  {1e3 * float(np.linalg.norm(residual)):.1f} mm"


def _log_vectors(
    writer: Writer,
    path: str,
    vectors: Mapping[str, Array],
    origins: Mapping[str, Array],
    what: str,
    color: Rgb,
) -> str | None:
    """Arrows, exaggerated by a factor that the entity's name states."""
    if not vectors:
        return None
    values = np.array(list(vectors.values()))
    lengths = np.linalg.norm(values, axis=1)
    factor = exaggeration(lengths, writer.scene.focus[1])
    names = [
        f"{name}: {1e3 * length:.1f} mm, drawn {factor} times" for name, length in zip(vectors, lengths, strict=True)
    ]
    arrows = rr.Arrows3D(
        vectors=factor * values,
        origins=np.array([origins[name] for name in vectors]),
        colors=color,
        labels=names,
        show_labels=False,
        radii=rr.Radius.ui_points(1.5),
    )
    entity = f"{path}_times_{factor}"
    writer.log(entity, arrows)
    writer.legend.append((entity, f"{what}, drawn {factor} times"))
    return entity


def log_moves(writer: Writer) -> None:
    """What the adjustment changed of the poses from PnP; switched off at first."""
    scene = writer.scene
    both = [name for name in scene.adjusted if name in scene.localized]
    moves = {n: scene.adjusted[n].translation - scene.localized[n].translation for n in both}
    origins = {name: scene.localized[name].translation for name in both}
    entity = _log_vectors(writer, "world/moved_by_adjustment", moves, origins, "from PnP to adjusted position", SIGMA)
    if entity:
        writer.hidden.append(f"/{entity}")


def log_sigmas(writer: Writer) -> None:
    """Ellipsoids of 1 sigma of the adjusted positions; switched off at first."""
    scene = writer.scene
    names = [name for name in scene.adjusted if name in scene.position_covs]
    if not names:
        return
    values, vectors = np.linalg.eigh(np.array([scene.position_covs[name] for name in names]))
    half = np.sqrt(np.maximum(values, 0.0))
    factor = exaggeration(half.max(axis=1), scene.focus[1])
    vectors *= np.sign(np.linalg.det(vectors))[:, None, None]
    ellipsoids = rr.Ellipsoids3D(
        centers=np.array([scene.adjusted[name].translation for name in names]),
        half_sizes=factor * half,
        quaternions=Rotation.from_matrix(vectors).as_quat(),
        colors=SIGMA,
        labels=[
            f"{name}: sigma {', '.join(f'{1e3 * s:.1f}' for s in row)} mm"
            for name, row in zip(names, half, strict=True)
        ],
        show_labels=False,
    )
    entity = f"world/position_sigmas_times_{factor}"
    writer.log(entity, ellipsoids)
    writer.hidden.append(f"/{entity}")
    writer.legend.append((entity, f"1 sigma of the adjusted positions, drawn {factor} times; switched off at first"))
