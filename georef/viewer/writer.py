"""The open recording that all entities are written to, and their colours."""

from __future__ import annotations

from dataclasses import dataclass, field

import rerun as rr

from georef.types.constraints import CheckKind
from georef.viewer.scene import Scene

Rgb = tuple[int, int, int]
NEW, REFERENCE, CONTROL = (255, 149, 0), (130, 150, 175), (190, 110, 255)
CHECK = {CheckKind.ABSOLUTE: (70, 220, 120), CheckKind.RELATIVE: (70, 200, 255)}
RESIDUAL, UNDETERMINED, SIGMA = (255, 60, 60), (150, 150, 150), (255, 210, 120)


@dataclass
class Writer:
    """The open recording, and what has been said of its entities so far."""

    scene: Scene
    stream: rr.RecordingStream
    longest_side_px: int
    legend: list[tuple[str, str]] = field(default_factory=list)
    hidden: list[str] = field(default_factory=list)
    image_paths: list[tuple[str, str]] = field(default_factory=list)
    into_images: list[str] = field(default_factory=list)

    def log(self, path: str | list[object], *what: rr.AsComponents) -> None:
        self.stream.log(path, what[0], *what[1:], static=True)
