"""Components of the tables, those without free weights with weights made here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from made_weights import MADE, put_into_cache

from georef.errors import WeightsError
from georef.features.registry import ComponentTable, load_component

Make = Callable[[ComponentTable, str], Any]
_made: dict[tuple[str, str], Any] = {}


@pytest.fixture(scope="session")
def made_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GEOREF_CACHE", str(folder / "cache"))
        put_into_cache(folder)
    return folder / "cache"


@pytest.fixture
def component(made_cache: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    """Makes a component by name, once; skips the test where its weights are free and not in the cache."""

    def make(table: ComponentTable, name: str) -> Any:
        if getattr(table.resolve(name).load(), "weights", None) in MADE:
            monkeypatch.setenv("GEOREF_CACHE", str(made_cache))
        try:
            if (table.kind, name) not in _made:
                _made[table.kind, name] = load_component(table, name)
        except WeightsError as error:
            pytest.skip(f"weights of {name} are not in the cache: {str(error).splitlines()[0]}")
        return _made[table.kind, name]

    return make


@pytest.fixture
def with_trained_weights() -> Callable[[Any], None]:
    """Skips what only training can give."""

    def check(made: Any) -> None:
        if getattr(made, "weights", None) in MADE:
            pytest.skip(f"{made.name} has weights made here, which mean nothing")

    return check
