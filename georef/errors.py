"""The exception tree.

GeorefError                 everything that georef raises on purpose; exit code 1, message only
├── InputError              a file, row or value that the user supplied
├── ConfigError             a key or value of project.toml, a preset or --set
├── CrsError                a coordinate reference system, a transform, a missing grid
├── WeightsError            weights of a learned component that are missing or do not match their hash
└── StageError              a stage that cannot run, or whose stored results cannot be used

A message says what is wrong with the value, what was expected, what to do next, and where it stands, last.
"""

from __future__ import annotations

from pathlib import Path


class GeorefError(Exception):
    """Base of all errors that are meant for the user. The lines together are the message, complete as it is."""

    def __init__(self, *lines: str) -> None:
        super().__init__("\n".join(line for line in lines if line))


class InputError(GeorefError):
    """A value in a file that cannot be used.

    problem says what is wrong (with the value), expected what would be right, remedy what to do; the place (file
    and row, counted from 1 as an editor counts lines) comes last.
    """

    def __init__(
        self,
        problem: str,
        *,
        expected: str = "",
        remedy: str = "",
        path: Path | str | None = None,
        row: int | None = None,
    ) -> None:
        self.problem, self.expected, self.remedy = problem, expected, remedy
        self.path, self.row = path, row
        super().__init__(self._compose())

    def _compose(self) -> str:
        lines = [self.problem]
        if self.expected:
            lines.append(f"Expected {self.expected}")
        if self.remedy:
            lines.append(self.remedy)
        if self.path is not None:
            where = f"row {self.row} of {self.path}" if self.row is not None else str(self.path)
            lines.append(f"In {where}.")
        return "\n".join(lines)


class ConfigError(GeorefError):
    """A key or value of the configuration that cannot be used."""


class CrsError(GeorefError):
    """A coordinate reference system that is unknown, incomplete, or cannot be reached exactly."""


class WeightsError(GeorefError):
    """Weights that are missing or differ from their pinned hash; the message names the command that fetches them."""


class StageError(GeorefError):
    """A stage that cannot run with what it was given."""
