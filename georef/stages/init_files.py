"""What `init` finds in a folder of data, by the usual names of files.

reference_eo.csv  reference/   or, for several reference epochs,  <name>_eo.csv  <name>/
<epoch>_gnss.csv  <epoch>/     camera.csv, or cameras_<epoch>.csv for an epoch of its own cameras
rig.csv, or rig_<epoch>.csv    how the cameras of an epoch are mounted
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from georef.errors import InputError
from georef.project import REFERENCE

EO_SUFFIX, GNSS_SUFFIX, CAMERAS = "_eo.csv", "_gnss.csv", "camera.csv"
RIG = "rig.csv"
ORIENTATION = REFERENCE + EO_SUFFIX


@dataclass(frozen=True)
class Found:
    """Names of reference epochs and of new ones, and which table of cameras there is for each."""

    data: Path
    references: tuple[str, ...]
    epochs: tuple[str, ...]

    @property
    def orientations(self) -> list[str]:
        return [name + EO_SUFFIX for name in self.references]

    def cameras(self, epoch: str) -> str | None:
        """The camera table of an epoch; None: there is none."""
        return self._first(f"cameras_{epoch}.csv", f"camera_{epoch}.csv", CAMERAS)

    def rig(self, epoch: str) -> str | None:
        """The table of the rig of an epoch; None: there is none."""
        return self._first(f"rig_{epoch}.csv", RIG)

    def _first(self, *usual: str) -> str | None:
        return next((name for name in usual if (self.data / name).is_file()), None)


def find_files(data: Path) -> Found:
    """Raises InputError for a folder that lacks a reference, a new epoch, or any table of cameras."""
    if not data.is_dir():
        raise InputError("The folder of the data does not exist.", remedy="Correct --data.", path=data)
    references = _named(data, EO_SUFFIX)
    if REFERENCE in references:
        references = [REFERENCE]
    missing = [] if references else [name for name in (ORIENTATION, REFERENCE) if not (data / name).exists()]
    cameras = [*data.glob("camera_*.csv"), *data.glob("cameras_*.csv"), *data.glob(CAMERAS)]
    missing += [] if cameras else [CAMERAS]
    if missing or not references:
        raise InputError(
            f"The folder has no {' and no '.join(missing or [ORIENTATION])}.",
            expected=f"{ORIENTATION} (poses of the reference), {REFERENCE}/ (its images), {CAMERAS} (the camera); of "
            f"several reference epochs <name>{EO_SUFFIX}, <name>/.",
            remedy="Rename the files, or write project.toml by hand: it can name any file.",
            path=data,
        )
    epochs = [name for name in _named(data, GNSS_SUFFIX) if name not in references]
    if not epochs:
        raise InputError(
            "The folder has no new epoch.",
            expected=f"a table <epoch>{GNSS_SUFFIX} beside a folder <epoch>/ with the new images.",
            remedy="Rename the files, or write project.toml by hand: an epoch needs no GNSS there.",
            path=data,
        )
    return Found(data, tuple(references), tuple(epochs))


def _named(data: Path, suffix: str) -> list[str]:
    """Names of the tables of a kind that stand beside a folder of the same name."""
    names = sorted(p.name.removesuffix(suffix) for p in data.glob(f"*{suffix}"))
    return [name for name in names if (data / name).is_dir()]
