"""How long each step of a computation takes."""

from __future__ import annotations

import time


class StepTimer:
    """Adds the CPU seconds of a block to a step."""

    def __init__(self, times: dict[str, float], step: str) -> None:
        self.times, self.step = times, step

    def __enter__(self) -> None:
        self.start = time.process_time()

    def __exit__(self, *_: object) -> None:
        self.times[self.step] = self.times.get(self.step, 0.0) + time.process_time() - self.start
