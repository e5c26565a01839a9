"""What a block's result was made from, and whether it still is what the project declares."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from georef.project import Project

RESULT = "report.json"


def block_inputs(project: Project, name: str) -> dict[str, str]:
    """Digests by name: of the sections that say what a block is, and of the files that they name."""
    section, points = project.file.blocks[name], project.file.points
    stated = {
        "[crs]": project.file.crs.model_dump(),
        f"[blocks.{name}]": section.model_dump(),
        "[points]": None if points is None else points.model_dump(),
        "[adjust]": project.config.adjust.model_dump(),
    }
    rig, compare = section.mounted, section.compare
    named = [
        section.observations.file,
        section.cameras,
        None if section.gnss is None else section.gnss.file,
        None if section.attitude == "vertical" else section.attitude.file,
        None if rig is None else rig.file,
        None if points is None else points.coordinates,
        *(() if compare is None else (compare.camera, compare.parameters)),
    ]
    out = {what: _digest(json.dumps(value, sort_keys=True, default=str).encode()) for what, value in stated.items()}
    return out | {file: _digest(project.data(file).read_bytes()) for file in named if file is not None}


def block_state(project: Project, name: str) -> tuple[str, str]:
    """ "done", "stale" or "new", and what changed. Raises OSError for a file that cannot be read."""
    path = project.published(name) / RESULT
    if not path.is_file():
        return "new", "not adjusted yet"
    report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    before, now = report.get("inputs", {}), block_inputs(project, name)
    changed = sorted(what for what in {*before, *now} if before.get(what) != now.get(what))
    if changed:
        return "stale", "changed: " + ", ".join(changed)
    data = report["data"]
    return "done", f"{data['images']} images, {data['image_observations']} observations"


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
