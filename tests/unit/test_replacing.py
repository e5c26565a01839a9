"""Files that are replaced when the new one is complete, and not before."""

from __future__ import annotations

from pathlib import Path

import pytest

from georef.replacing import replacing


def test_the_file_is_replaced_at_the_end_of_the_block(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    for text in ("first", "second"):
        with replacing(path) as temporary:
            assert (temporary.parent, temporary.suffix) == (path.parent, ".tmp")
            temporary.write_text(text, encoding="utf-8")
            assert not path.is_file() or path.read_text(encoding="utf-8") == "first"
        assert path.read_text(encoding="utf-8") == text
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]


def test_a_block_that_fails_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    path.write_text("old", encoding="utf-8")

    def write_half() -> None:
        with replacing(path, ".laz") as temporary:
            assert temporary.suffix == ".laz"
            temporary.write_text("half", encoding="utf-8")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_half()
    assert path.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]
