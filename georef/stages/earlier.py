"""What earlier runs of a stage left that still holds: an epoch that only gained images is not begun anew.

A run notes a digest of what each image's result depends on. A later run, whose other inputs are the same, takes over
the results of the images whose digest is the same.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from georef.io.files import write_text_atomically
from georef.io.items import item_path
from georef.stages.base import StageContext

BEGUN, INPUTS = "fingerprint.json", "inputs.json"


def earlier_runs(context: StageContext, stage: str, aside: Collection[str]) -> Iterator[tuple[Path, dict[str, str]]]:
    """Folders of earlier runs of a stage, newest first, whose fingerprints agree but for the parts named aside, and the
    digests of the inputs of their images."""
    mine = _without(_read(context.folder / BEGUN), aside)
    for folder in reversed(context.project.stage_history(context.epoch, stage)) if mine is not None else ():
        inputs = _read(folder / INPUTS)
        alike = _without(_read(folder / BEGUN), aside) == mine
        if inputs is not None and alike and folder != context.folder:
            yield folder, inputs


def note_inputs(folder: Path, inputs: Mapping[str, str]) -> None:
    """Stores the digests of what the results of images depend on, before any result."""
    write_text_atomically(json.dumps(dict(inputs)), folder / INPUTS)


def take_over(context: StageContext, stage: str, items: str, inputs: Mapping[str, str], aside: Collection[str]) -> int:
    """Takes over results of images that earlier runs of the stage computed from the same inputs; how many."""
    taken = 0
    for folder, before in earlier_runs(context, stage, aside):
        for name, digest in inputs.items():
            mine, theirs = item_path(context.folder / items, name), item_path(folder / items, name)
            if before.get(name) == digest and theirs.is_file() and not mine.exists():
                mine.parent.mkdir(parents=True, exist_ok=True)
                _copy(theirs, mine)
                taken += 1
    return taken


def _copy(source: Path, target: Path) -> None:
    """A link where the file system has them, else a copy that is there as a whole or not at all."""
    try:
        os.link(source, target)
    except OSError:
        temporary = target.with_suffix(".copy")
        shutil.copy2(source, temporary)
        temporary.replace(target)


def _without(parts: dict[str, Any] | None, aside: Collection[str]) -> dict[str, Any] | None:
    return None if parts is None else {name: value for name, value in parts.items() if name not in aside}


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
