"""Results of stages on disk: named arrays with a JSON header in one .npz file; no pickles, complete or absent."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from georef.errors import StageError
from georef.geometry.camera import Camera
from georef.geometry.rigid import Rigid3
from georef.io.files import write_bytes_atomically
from georef.types.results import Localized, Outcome, ReferenceMatches, Rejected, RejectReason

_HEADER = "header_json"
_SUFFIX = ".npz"


def item_path(folder: Path, item_id: str) -> Path:
    """Where the result of an item lies; ids may hold any characters."""
    return folder / f"{quote(item_id, safe='')}{_SUFFIX}"


def item_ids(folder: Path) -> set[str]:
    """Ids of the items that have a result."""
    return {unquote(path.name.removesuffix(_SUFFIX)) for path in folder.glob(f"*{_SUFFIX}")}


def write_item(path: Path, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Writes a header and arrays under a temporary name, then puts the file in place."""
    buffer = io.BytesIO()
    encoded = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    np.savez(buffer, allow_pickle=False, **{_HEADER: encoded}, **arrays)
    write_bytes_atomically(buffer.getvalue(), path)


def read_item(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a result. Raises StageError for a file that is missing or damaged."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files if name != _HEADER}
            return json.loads(stored[_HEADER].tobytes()), arrays
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError) as error:
        raise StageError(
            f"A stored result cannot be read: {error}.",
            "Delete the file and run again; only this item is computed anew.",
            f"In {path}.",
        ) from None


def write_outcome(path: Path, outcome: Outcome) -> None:
    """Stores the outcome of one image."""
    if isinstance(outcome, Rejected):
        header = {"image_id": outcome.image_id, "reason": outcome.reason.value, "detail": outcome.detail}
        write_item(path, {**header, **_told(outcome)}, {})
        return
    header = {
        "image_id": outcome.image_id,
        "correspondence_count": outcome.correspondence_count,
        "sigma0": outcome.sigma0,
        "references": [m.reference_id for m in outcome.matches],
        "gnss_rejected": outcome.gnss_rejected,
        "gnss_offset_m": outcome.gnss_offset_m,
        "quarter_turns": outcome.quarter_turns,
        **_told(outcome),
        "camera": None if outcome.camera is None else asdict(outcome.camera),
    }
    arrays = {
        "world_from_cam": outcome.world_from_cam.matrix(),
        "cov": outcome.world_from_cam_cov,
        "relative_cov": outcome.relative_cov,
        "points": outcome.points_in_world,
        "keypoints": outcome.keypoints,
    }
    if outcome.intrinsics_cov is not None:
        arrays["intrinsics_cov"] = outcome.intrinsics_cov
    write_item(path, header, arrays | {f"matches_{i}": m.indices for i, m in enumerate(outcome.matches)})


def read_outcome(path: Path) -> Outcome:
    """The stored outcome of one image."""
    header, arrays = read_item(path)
    told = {
        "notes": tuple(header["notes"]),
        "cpu_s": header["cpu_s"],
        "candidates": tuple(header["candidates"]),
    }
    if "reason" in header:
        return Rejected(header["image_id"], RejectReason(header["reason"]), header["detail"], **told)
    matches = (ReferenceMatches(name, arrays[f"matches_{i}"]) for i, name in enumerate(header["references"]))
    return Localized(
        image_id=header["image_id"],
        world_from_cam=Rigid3.from_matrix(arrays["world_from_cam"]),
        world_from_cam_cov=arrays["cov"],
        relative_cov=arrays["relative_cov"],
        correspondence_count=header["correspondence_count"],
        sigma0=header["sigma0"],
        matches=tuple(matches),
        points_in_world=arrays["points"],
        keypoints=arrays["keypoints"],
        gnss_rejected=header["gnss_rejected"],
        gnss_offset_m=header["gnss_offset_m"],
        quarter_turns=header["quarter_turns"],
        **told,
        camera=None if header.get("camera") is None else camera_of(header["camera"]),
        intrinsics_cov=arrays.get("intrinsics_cov"),
    )


def _told(outcome: Outcome) -> dict[str, Any]:
    """What both kinds of outcome say of how they came about."""
    return {"notes": outcome.notes, "cpu_s": outcome.cpu_s, "candidates": outcome.candidates}


def camera_of(stored: dict[str, Any]) -> Camera:
    """A camera that was stored as a dictionary of its fields."""
    lists = {"distortion": tuple(stored["distortion"]), "estimate": tuple(stored["estimate"])}
    return Camera(**{**stored, **lists})
