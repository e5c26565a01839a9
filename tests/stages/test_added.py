"""An epoch to which images are added: what did not change is kept, and the adjustment goes on from what stands."""

from __future__ import annotations

import csv
from collections.abc import Callable

import numpy as np

from tests.stages.bench import Bench
from tests.worlds.tiny import EPOCH

_SETTING = "adjust.update_from_images=2"


def _positions(bench: Bench) -> np.ndarray:
    rows = csv.DictReader(line for line in bench.published("poses.csv").decode().splitlines() if line[:1] != "#")
    return np.array([[float(row[name]) for name in list(row)[1:4]] for row in rows])


def test_images_that_were_there_are_not_localized_again_and_the_adjustment_goes_on(
    copied: Callable[..., Bench],
) -> None:
    bench = copied(data=True)
    whole = bench.run()  # all images, adjusted from the start
    expected = bench.published("poses.csv")
    image, tables = bench.data / EPOCH / "n2.jpg", (f"{EPOCH}_gnss.csv", f"marks_{EPOCH}.csv")
    kept = image.read_bytes(), [(bench.data / name).read_text(encoding="utf-8") for name in tables]
    times = image.stat()
    image.unlink()
    for name, text in zip(tables, kept[1], strict=True):
        rows = [line for line in text.splitlines(keepends=True) if "n2.jpg" not in line]
        (bench.data / name).write_text("".join(rows), encoding="utf-8")
    fewer = bench.run(_SETTING)
    assert (fewer["localize"].summary.computed, fewer["localize"].summary.total) == (0, 2)
    assert fewer["adjust"].summary.data["updated_from"] is None
    image.write_bytes(kept[0])
    for name, text in zip(tables, kept[1], strict=True):
        (bench.data / name).write_text(text, encoding="utf-8")
    assert image.stat().st_mtime_ns != times.st_mtime_ns
    again = bench.run(_SETTING)
    assert (again["localize"].summary.computed, again["localize"].summary.total) == (1, 3)
    data = again["adjust"].summary.data
    assert data["updated_from"] == fewer["adjust"].context.folder.name
    assert data["images"] == whole["adjust"].summary.data["images"]
    updated = _positions(bench)
    bench_expected = csv.DictReader(line for line in expected.decode().splitlines() if line[:1] != "#")
    before = np.array([[float(row[name]) for name in list(row)[1:4]] for row in bench_expected])
    assert np.abs(updated - before).max() < 2e-3
    # Whoever wants no update gets none.
    assert bench.run("adjust.update_from_images=0")["adjust"].summary.data["updated_from"] is None
