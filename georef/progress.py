"""What long work shows: a bar on a terminal, lines in a log."""

from __future__ import annotations

import logging
import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

_LINE_EVERY_S = 30.0
logger = logging.getLogger("georef.progress")


class Bars:
    """One bar at a time on stderr; gone when its work is done."""

    def __init__(self) -> None:
        columns = (TextColumn("{task.description:<10}"), BarColumn(), MofNCompleteColumn())
        self._progress = Progress(
            *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=Console(stderr=True), transient=True
        )

    def begin(self, label: str, total: int) -> None:
        self._progress.start()
        self._task = self._progress.add_task(label, total=total)

    def advance(self, done: int = 1) -> None:
        self._progress.advance(self._task, done)

    def end(self) -> None:
        self._progress.remove_task(self._task)
        self._progress.stop()


class Lines:
    """A line to stderr from time to time."""

    def begin(self, label: str, total: int) -> None:
        self._label, self._total, self._done, self._last = label, total, 0, time.monotonic()

    def advance(self, done: int = 1) -> None:
        self._done += done
        if time.monotonic() - self._last >= _LINE_EVERY_S:
            self._last = time.monotonic()
            Console(stderr=True).print(f"{self._label}: {self._done} of {self._total}", highlight=False)

    def end(self) -> None: ...
