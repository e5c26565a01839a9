"""One piece of work in a fresh process: what it costs, undisturbed by what ran before it."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Cost(Generic[T]):
    """Seconds and peak resident memory of a piece of work, start of the process and imports included in the memory."""

    result: T
    wall_s: float
    cpu_s: float
    peak_mb: float


def measured(work: Callable[..., T], *arguments: Any) -> Cost[T]:
    """Runs `work`, a function of a module, in a new process."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_run, work, arguments).result()


class Waiting(Generic[T]):
    """An iterable that knows how long its consumer waited for it."""

    def __init__(self, items: Iterable[T]) -> None:
        self._items = items
        self.wall_s = self.cpu_s = 0.0

    def __iter__(self) -> Iterator[T]:
        items = iter(self._items)
        while True:
            wall, cpu = time.perf_counter(), time.process_time()
            try:
                item = next(items)
            except StopIteration:
                return
            finally:
                self.wall_s += time.perf_counter() - wall
                self.cpu_s += time.process_time() - cpu
            yield item


def disk_mb(folder: Path) -> float:
    """Size of all files in a folder, in units of 1e6 bytes."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """Aligned lines: the first column to the left, numbers to the right."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    cells = [[text.rjust(width) for text, width in zip(row, widths, strict=True)] for row in [header, *rows]]
    for line, row in zip(cells, [header, *rows], strict=True):
        line[0] = row[0].ljust(widths[0])
    lines = ["  ".join(line).rstrip() for line in cells]
    return [lines[0], "  ".join("-" * width for width in widths), *lines[1:]]


def _run(work: Callable[..., T], arguments: tuple[Any, ...]) -> Cost[T]:
    wall, cpu = time.perf_counter(), time.process_time()
    result = work(*arguments)
    return Cost(result, time.perf_counter() - wall, time.process_time() - cpu, _peak_mb())


def _peak_mb() -> float:
    """Peak resident memory of this process, pages of mapped files included (1e6 bytes)."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) * 1024 / 1e6
