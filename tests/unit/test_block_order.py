"""Orders of elimination: complete whatever the graph of the stations looks like."""

from __future__ import annotations

import numpy as np
import pytest

from georef.estimation.adjustment.equations.block_order import fronts_of


def pattern(stations: int, parts: int, density: float, alone: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of blocks: parts that share nothing, and the first stations with no partner at all."""
    rng = np.random.default_rng(seed)
    part = rng.integers(0, parts, stations)
    pairs = [(i, i) for i in range(stations)]
    pairs += [
        (a, b)
        for a in range(alone, stations)
        for b in range(a + 1, stations)
        if part[a] == part[b] and rng.random() < density
    ]
    row, column = np.array(pairs).T
    return row, column


@pytest.mark.parametrize("alone", [0, 1, 5, 30])
@pytest.mark.parametrize("parts", [1, 3])
def test_every_station_is_eliminated_once(alone: int, parts: int) -> None:
    """Stations without partners among them: METIS alone corrupts memory on those."""
    for seed, density in enumerate((0.05, 0.3, 1.0)):
        fronts = fronts_of(30, *pattern(30, parts, density, alone, seed))
        pivots = np.concatenate([front.members[: front.pivots] for front in fronts])
        assert sorted(pivots.tolist()) == list(range(30))
        for front in fronts:
            if front.parent >= 0:
                assert set(front.members[front.pivots :]) <= set(fronts[front.parent].members)
            else:
                assert len(front.members) == front.pivots
