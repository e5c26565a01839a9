"""What an epoch has published: where it lies, and its report rendered again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from georef.errors import StageError
from georef.io.files import write_text_atomically
from georef.report.html import render_html
from georef.stages.report import HTML, LOCALIZATION, POSES, RECORDING, REPORT, TEXT

_WHAT = {
    POSES: "poses after the adjustment",
    LOCALIZATION: "poses of each image alone",
    HTML: "the report to read",
    REPORT: "the report as data",
    TEXT: "the adjustment as text",
    RECORDING: "the 3D scene: georef view",
}


def published_files(folder: Path) -> list[tuple[Path, str]]:
    """The files that an epoch's folder holds, each with what it is."""
    return [(folder / name, what) for name, what in _WHAT.items() if (folder / name).is_file()]


def render_again(folder: Path) -> Path:
    """Renders report.html anew from report.json. Raises StageError where there is none that can be read."""
    stored = _stored_report(folder / REPORT)
    write_text_atomically(render_html(stored), folder / HTML)
    return folder / HTML


def _stored_report(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        problem = "This epoch has no report yet."
    except (OSError, ValueError) as error:
        problem = f"The report cannot be read: {error}."
    raise StageError(problem, "Run the project first: georef run PROJECT.", f"In {path}.")
