"""Fixtures of all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.worlds.tiny import TinyWorld, write_tiny_world


@pytest.fixture(scope="session")
def georef_data() -> Path:
    """The folder of real data with truth; tests that need it are skipped, with the reason, where there is none."""
    named = os.environ.get("GEOREF_DATA")
    if not named:
        pytest.skip("real data: the environment variable GEOREF_DATA does not name their folder")
    if not (Path(named) / "castle").is_dir():
        pytest.skip(f"real data: GEOREF_DATA is {named}, which has no folder castle")
    return Path(named)


@pytest.fixture(scope="session")
def tiny_world(tmp_path_factory: pytest.TempPathFactory) -> TinyWorld:
    """The small rendered world; not to be changed: copy it (`copy_of`)."""
    return write_tiny_world(tmp_path_factory.mktemp("tiny"))


@pytest.fixture
def tiny_tables(tmp_path: Path) -> Path:
    """A folder of one test's own with the tables of the small world and empty image files."""
    return write_tiny_world(tmp_path / "tables", rendered=False).data
