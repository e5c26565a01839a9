"""Intervals of shares, cumulative curves, recall of retrieval, and tables as CSV and JSON."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from georef.evaluation.curves import CumulativeCurve, round_limits
from georef.evaluation.retrieval import retrieval_quality, right_references
from georef.evaluation.statistics import wilson_interval
from georef.evaluation.tables import Column, Estimate, Table, shown
from georef.geometry.rigid import Rigid3, exp_so3
from georef.types.campaign import Image
from tests.worlds.points import CAMERA


@pytest.mark.parametrize(("count", "total"), [(0, 10), (9, 9), (50, 100), (3, 7), (999, 1000)])
def test_wilson_limits_are_the_shares_that_the_count_just_does_not_refute(count: int, total: int) -> None:
    interval = wilson_interval(count, total)
    assert interval is not None
    z = norm.ppf(0.975)
    for limit in interval:
        share = limit / 100.0
        off = abs(count / total - share) - z * np.sqrt(share * (1.0 - share) / total)
        assert off == pytest.approx(0.0, abs=1e-9)
    assert interval[0] <= 100.0 * count / total <= interval[1]


def test_wilson_against_published_figures() -> None:
    assert wilson_interval(0, 10) == pytest.approx((0.0, 27.75), abs=0.01)
    assert wilson_interval(81, 263) == pytest.approx((25.5, 36.6), abs=0.05)  # Newcombe (1998), table I
    assert wilson_interval(0, 0) is None


def test_a_curve_counts_images_without_a_pose() -> None:
    curve = CumulativeCurve.of([0.02, np.inf, 0.005, 0.02])
    assert curve.at([0.001, 0.005, 0.019, 0.02, 5.0]) == pytest.approx([0.0, 25.0, 25.0, 75.0, 75.0])
    assert (curve.errors.tolist(), curve.percent.tolist(), curve.total) == ([0.005, 0.02, 0.02], [25.0, 50.0, 75.0], 4)
    assert np.isnan(CumulativeCurve.of([]).at([1.0])).all()


def test_round_limits_reach_both_ends() -> None:
    limits = round_limits(0.0005, 1.0)
    assert limits == [0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0]
    assert (round_limits(0.005, 10.0)[0], round_limits(0.005, 10.0)[-1]) == (0.005, 10.0)


def test_recall_counts_queries_and_leaves_out_those_without_a_right_reference() -> None:
    right = {"a": frozenset("x"), "b": frozenset("y"), "c": frozenset("zw"), "d": frozenset()}
    found = {"a": ("x", "y"), "b": ("p", "q", "y"), "d": ("x",)}
    quality = retrieval_quality(found, right)
    assert [r.percent for r in quality.recall] == pytest.approx([100 / 3, 200 / 3, 200 / 3])
    assert quality.recall[0].interval == wilson_interval(1, 3)
    assert quality.precision_percent == pytest.approx(100.0 * (1 / 2 + 1 / 3 + 0) / 3)
    assert (quality.judged, quality.without) == (3, ("d",))
    assert retrieval_quality({}, {"d": frozenset()}).recall[0].percent is None


def test_right_references_look_at_the_same_place() -> None:
    def image(name: str, turn_deg: float, x: float) -> Image:
        pose = Rigid3(exp_so3(np.array([0.0, np.radians(turn_deg), 0.0])), np.array([x, 0.0, 0.0]))
        return Image(name, Path(name), CAMERA, "e", world_from_cam=pose)

    references = [image("same", 5.0, 1.0), image("back", 180.0, 0.0), image("far", 0.0, 100.0)]
    query = image("q", 0.0, 0.0)
    assert query.world_from_cam is not None
    right = right_references([query, image("unknown", 0.0, 0.0)], {"q": query.world_from_cam}, references)
    assert right == {"q": frozenset({"same"})}


COLUMNS = (
    Column("name", ""),
    Column("median", "median", "m", 1, 1e3, "mm", interval=True),
    Column("share", "share", "%", 0, interval=True),
    Column("time", "time", "s", 1),
)
TABLE = Table(
    "t",
    "T",
    COLUMNS,
    (
        {"name": 'a, "b"', "median": Estimate(0.0123456, (0.01, np.inf)), "share": Estimate(50.0, (40.0, 60.0))},
        {"name": "none", "median": Estimate(np.inf), "time": 1234.56},
    ),
)


def test_csv_keeps_base_units_and_reads_back() -> None:
    rows = list(csv.DictReader(io.StringIO(TABLE.csv())))
    assert list(rows[0]) == [
        *("name", "median_m", "median_m_low", "median_m_high"),
        *("share_percent", "share_percent_low", "share_percent_high", "time_s"),
    ]
    assert rows[0]["name"] == 'a, "b"'
    assert (float(rows[0]["median_m"]), float(rows[0]["median_m_high"])) == (0.0123456, np.inf)
    assert (rows[1]["median_m"], rows[1]["median_m_low"], rows[1]["share_percent"]) == ("inf", "", "")
    assert float(rows[1]["time_s"]) == 1234.56


def test_json_is_free_of_infinity_and_cells_are_shown_in_their_units() -> None:
    data = json.loads(json.dumps(TABLE.to_dict(), allow_nan=False))
    assert data["rows"][0]["median"] == {"value": 0.0123456, "interval_95": [0.01, "infinite"]}
    assert data["rows"][1]["median"]["value"] == "infinite"
    assert data["shown"][0][1] == ["12.3", "10.0 to \N{INFINITY}"]
    assert data["shown"][1] == [["none", ""], ["\N{INFINITY}", ""], ["\N{EN DASH}", ""], ["1\u202f234.6", ""]]
    assert data["columns"][1]["heading"] == "median (mm)"
    assert shown(COLUMNS[2], Estimate(None)) == ("\N{EN DASH}", "")
