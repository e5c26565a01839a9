"""The published poses, `poses.csv` and `localization.csv`: an exterior orientation with status and covariance.

    # CRS: EPSG:25832, height: ellipsoidal, metres. Angles: degrees, R = Rx(omega) Ry(phi) Rz(kappa), image ...
    # Covariance: cov_ij, upper triangle, of xi in T Exp(xi), T = world_from_cam; xi = rotation (rad), then ...
    image,easting,northing,height,omega,phi,kappa,status,cov_00..cov_55,sigma_e,...,sigma_kappa,angles_singular

Positions go to 0.1 mm, angles to 1e-6 deg. An image without a pose has a row with its status and empty numbers. Where
something of a camera was estimated with the pose, columns at the end have it: focal (fx, px), sigma_focal, k1 ...
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from georef.geometry.angles import omega_phi_kappa_from_rotation
from georef.geometry.camera import ESTIMABLE
from georef.geometry.covariance import COV_COLUMNS, from_upper_triangle, upper_triangle
from georef.geometry.rigid import Array
from georef.io.columns import POSITION_COLUMNS, SIGMA_COLUMNS, CrsKind
from georef.io.declarations import ANGLE_NAMES
from georef.io.exterior_orientation import ExteriorOrientationTable, exterior_orientation_from_table
from georef.io.files import write_text_atomically
from georef.io.pose_records import PoseRecord, PosesFrame, PoseTable, is_rejected, sigmas_from_cov
from georef.io.tables import Table, TableFormat, read_table
from georef.types.campaign import require_covariance

__all__ = ["PoseRecord", "PoseTable", "PosesFrame", "read_poses", "sigmas_from_cov", "write_poses"]

_ANGLES = ANGLE_NAMES["omega-phi-kappa"]
_ANGLE_SIGMAS = tuple(f"sigma_{name}" for name in _ANGLES)
_AXES_TEXT: dict[CrsKind, str] = {
    "projected": "grid (E, N, up)",
    "geographic": "local horizon (E, N, up)",
    "geocentric": "CRS (x, y, z)",
    "local": "site (x, y, z)",
}
_COVARIANCE_TEXT = (
    "Covariance: cov_ij, upper triangle, of xi in T Exp(xi) (right perturbation), T = world_from_cam; xi = rotation "
    "(rad) about, then translation (m) along the camera axes x right, y down, z forward."
)


def write_poses(records: Iterable[PoseRecord], path: Path | str, frame: PosesFrame) -> None:
    """Write poses, whole or not at all. Raises ValueError where an image comes twice, OSError where it cannot."""
    records = list(records)
    if len({record.image_id for record in records}) != len(records):
        raise ValueError("an image has two poses")
    lines = [f"# {_one_line(comment)}" for comment in _comments(frame)]
    estimated = [name for name in ESTIMABLE if any(name in record.intrinsics for record in records)]
    lines.append(",".join([*_header(frame.crs_kind), *(c for n in estimated for c in (n, f"sigma_{n}"))]))
    lines += [",".join([*_cells(r, frame.crs_kind), *_intrinsics(r, estimated)]) for r in records]
    write_text_atomically("\n".join(lines) + "\n", path)


def read_poses(
    path: Path | str,
    *,
    crs_kind: CrsKind | None = None,
    columns: Mapping[str, str] | None = None,
    table_format: TableFormat | None = None,
) -> PoseTable:
    """Read a file of write_poses, or a plain exterior orientation (omega-phi-kappa, degrees; status "given").

    Without crs_kind the names of the columns tell it, x, y, z being "local". Raises InputError as
    read_exterior_orientation does, and for rejected images with numbers and covariances that are none.
    """
    table = read_table(path, columns=columns, table_format=table_format, allow_no_rows=True)
    kind = crs_kind or _crs_kind(table)
    statuses = table.ids("status") if table.has("status") else ("given",) * len(table)
    table.require(("image", *POSITION_COLUMNS[kind], *_ANGLES))
    image_ids = table.unique_ids("image")
    posed = [i for i, status in enumerate(statuses) if not is_rejected(status)]
    _refuse_rejected_with_numbers(table, kind, set(range(len(table))) - set(posed))
    part = table.take(posed)
    orientation = exterior_orientation_from_table(part, crs_kind=kind, angles="omega-phi-kappa", angle_unit="deg")
    covs = _read_covs(part)
    poses = {index: _record(orientation, k, statuses[index], covs[k]) for k, index in enumerate(posed)}
    records = tuple(poses.get(i) or PoseRecord(image_ids[i], statuses[i]) for i in range(len(table)))
    return PoseTable(table.path, table.declared, kind, records)


def _comments(frame: PosesFrame) -> tuple[str, str]:
    crs = "Local engineering CRS" if frame.crs_kind == "local" else f"CRS: {frame.horizontal}"
    height = f", height: {frame.height}" if frame.height else ""
    unit = "degrees and metres" if frame.crs_kind == "geographic" else "metres"
    world = "axes x, y, z of the site" if frame.crs_kind == "local" else "topocentric east-north-up frame"
    angles = "Angles: degrees, R = Rx(omega) Ry(phi) Rz(kappa), image (right, top, back) to"
    return (
        f"{crs}{height}, {unit}. {angles} {_AXES_TEXT[frame.crs_kind]}.",
        f"{_COVARIANCE_TEXT} World: {world}, metres, origin at {frame.origin}.",
    )


def _header(kind: CrsKind) -> tuple[str, ...]:
    sigmas = (*SIGMA_COLUMNS[kind], *_ANGLE_SIGMAS)
    return ("image", *POSITION_COLUMNS[kind], *_ANGLES, "status", *COV_COLUMNS, *sigmas, "angles_singular")


def _cells(record: PoseRecord, kind: CrsKind) -> list[str]:
    image_id, status = _quoted(record.image_id), _quoted(record.status)
    if record.position_in_crs is None or record.axes_from_cam is None:
        return [image_id, *[""] * 6, status, *[""] * (len(COV_COLUMNS) + 7)]
    decimals = (10, 10, 4) if kind == "geographic" else (4, 4, 4)
    position = [f"{value:z.{n}f}" for value, n in zip(record.position_in_crs, decimals, strict=True)]
    angles = [f"{value:z.6f}" for value in np.rad2deg(omega_phi_kappa_from_rotation(record.axes_from_cam))]
    derived = (None, None) if record.cov is None else sigmas_from_cov(record.axes_from_cam, record.cov)
    position_sigmas = derived[0] if record.position_sigmas_m is None else record.position_sigmas_m
    angle_sigmas = derived[1] if record.angle_sigmas_deg is None else record.angle_sigmas_deg
    return [
        *(image_id, *position, *angles, status),
        *_optional(None if record.cov is None else upper_triangle(record.cov), len(COV_COLUMNS), ".9e"),
        *_optional(position_sigmas, 3, ".6g"),
        *_optional(None if record.angles_singular else angle_sigmas, 3, ".6g"),
        str(int(record.angles_singular)),
    ]


def _intrinsics(record: PoseRecord, names: Sequence[str]) -> list[str]:
    return [
        cell
        for name in names
        for cell in ([format(v, ".9g") for v in record.intrinsics[name]] if name in record.intrinsics else ["", ""])
    ]


def _optional(values: Array | None, count: int, spec: str) -> list[str]:
    return [""] * count if values is None else [format(float(value), spec) for value in values]


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _quoted(text: str) -> str:
    text = re.sub(r"[\r\n]+", " ", text)
    return '"' + text.replace('"', '""') + '"' if re.search(r'[,"]|^#', text) else text


def _crs_kind(table: Table) -> CrsKind:
    kinds: tuple[CrsKind, ...] = ("geographic", "local")
    for kind in kinds:
        if table.has(*POSITION_COLUMNS[kind]):
            return kind
    return "projected"


def _refuse_rejected_with_numbers(table: Table, kind: CrsKind, rejected: set[int]) -> None:
    names = [name for name in _header(kind)[1:-1] if name != "status" and table.has(name)]
    for name in names:
        values = table.text(name)
        for i in sorted(rejected):
            if values[i]:
                raise table.error(
                    i,
                    f"Image {table.text('image')[i]!r} is rejected and has {name} = {values[i]}.",
                    expected="no numbers: an image that is rejected has no pose.",
                    remedy="Delete the numbers, or correct the status.",
                )


def _read_covs(table: Table) -> list[Array | None]:
    if not any(table.has(name) for name in COV_COLUMNS):
        return [None] * len(table)
    values = table.stack(COV_COLUMNS, allow_empty=True)
    return [None if np.isnan(row).all() else _checked_cov(table, i, row) for i, row in enumerate(values)]


def _checked_cov(table: Table, index: int, values: Array) -> Array:
    cov = from_upper_triangle(values)
    try:
        require_covariance(cov, 6)
    except ValueError as error:
        raise table.error(
            index,
            f"The covariance of image {table.text('image')[index]!r} is not one: {error}.",
            expected=f"{len(COV_COLUMNS)} values {COV_COLUMNS[0]} to {COV_COLUMNS[-1]}, all or none.",
            remedy="Write the file again; it was changed by hand or cut off.",
        ) from error
    return cov


def _record(table: ExteriorOrientationTable, k: int, status: str, cov: Array | None) -> PoseRecord:
    def known(sigmas: Array | None) -> Array | None:
        return None if sigmas is None or np.isnan(sigmas[k]).any() else sigmas[k]

    angle_sigmas_rad = known(table.angle_sigmas_rad)
    return PoseRecord(
        table.image_ids[k],
        status,
        table.positions_in_crs[k],
        table.axes_from_cam[k],
        cov,
        known(table.position_sigmas_m),
        None if angle_sigmas_rad is None else np.rad2deg(angle_sigmas_rad),
    )
