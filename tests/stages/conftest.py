"""The small world, run once; tests copy what they want to change."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.stages.bench import Bench
from tests.worlds.tiny import TinyWorld


@pytest.fixture(scope="session")
def finished(tiny_world: TinyWorld, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """The small world with all stages done; not to be changed."""
    bench = Bench(tiny_world.data, tmp_path_factory.mktemp("output"))
    bench.run()
    return bench


@pytest.fixture
def copied(finished: Bench, tmp_path: Path) -> Callable[..., Bench]:
    """A copy of the finished results, and of the data where they are to be changed too."""

    def copy(*, data: bool = False) -> Bench:
        output = Path(shutil.copytree(finished.output, tmp_path / "output"))
        return Bench(Path(shutil.copytree(finished.data, tmp_path / "data")) if data else finished.data, output)

    return copy
