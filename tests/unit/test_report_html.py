"""The page: complete and self-contained for every mixture of points and outcomes, and true to the numbers."""

import copy
import re
from typing import Any

import numpy as np
import pytest

from georef.report.figures import plan_figures
from georef.report.html import render_html
from georef.report.wording import attention

MM = 1e-3


def summary(kind: str, count: int, ratio: float | None = 1.0) -> dict[str, Any]:
    known = count > 0
    out: dict[str, Any] = {"kind": kind, "count": count, "not_determined": 0}
    for i, key in enumerate(("e", "n", "h", "horizontal", "3d")):
        out[f"rmse_{key}_m"] = (4 + i) * MM if known else None
        out[f"rmse_{key}_interval_95_m"] = [(3 + i) * MM, (6 + i) * MM] if known else None
    nees = {
        "count": count,
        "dof": 3,
        "mean_ratio": ratio if known else None,
        "interval_95": [0.6, 1.5] if known else None,
    }
    consistent = (0.6 <= ratio <= 1.5) if known and ratio is not None else None
    return {
        **out,
        "mean_m": [MM, -MM, 0.0] if known else [None] * 3,
        "std_m": [2 * MM] * 3 if count > 1 else [None] * 3,
        "nees": {**nees, "effective_dof": None, "consistent": consistent},
        "nees_with_estimated_mark_sigma": None,
        "mark_sigma": {"factor": None, "sigma": None},
    }


def point(name: str, kind: str, vector_mm: tuple[float, float, float], *, sigma: bool = True) -> dict[str, Any]:
    e, n, h = (MM * v for v in vector_mm)
    return {
        "point_id": name,
        "kind": kind,
        "de_m": e,
        "dn_m": n,
        "dh_m": h,
        "distance_m": float(np.linalg.norm([e, n, h])),
        "image_count": 3,
        "mark_count": 3,
        "residual_rms_px": 0.25,
        "predicted_sigma_m": [5 * MM, 6 * MM, 7 * MM] if sigma else None,
        "nees": 2.5 if sigma else None,
    }


def checks(points: list[dict[str, Any]], missing: list[dict[str, Any]], ratio: float = 1.0) -> dict[str, Any]:
    kinds = [k for k in ("absolute", "relative") if any(p["kind"] == k for p in [*points, *missing])]
    by_kind = {k: summary(k, sum(p["kind"] == k for p in points), ratio) for k in kinds}
    top = by_kind[kinds[0]] if kinds else {"count": 0, "kind": None}
    return {**top, "by_kind": by_kind, "points": points, "not_determined": missing}


def localized(name: str) -> dict[str, Any]:
    return {
        "image": name,
        "status": "localized",
        "correspondences": 2535,
        "references": 10,
        "sigma0": 1.2,
        "pnp_sigma_m": [8 * MM, 9 * MM, 7 * MM],
        "gnss_rejected": False,
        "gnss_offset_m": None,
        "notes": [],
        "cpu_s": {"pose": 1.0},
        "adjustment": {
            "observations": 1176,
            "residual_rms_px": 0.47,
            "sigma_m": [6 * MM, 7 * MM, 5 * MM],
            "gnss_residual_m": [0.1, -0.46, 0.82],
            "gnss_sigma_m": [1.5, 1.5, 3.0],
        },
    }


def rejected(name: str) -> dict[str, Any]:
    return {"image": name, "status": "rejected", "reason": "few_inliers", "detail": "9 of 12", "notes": []}


def report(
    images: list[dict[str, Any]],
    points: list[dict[str, Any]],
    missing: list[dict[str, Any]] | None = None,
    **changes: Any,
) -> dict[str, Any]:
    missing = missing or []
    posed = [i for i in images if i["status"] == "localized"]
    station = {"position_m": [500.0, 800.0, 2.0], "direction": [0.6, 0.8, 0.0]}
    placed = [
        {"point_id": p["point_id"], "kind": p["kind"], "position_m": [510.0 + i, 805.0, 3.0]}
        | {"residual_m": [p["de_m"], p["dn_m"], p["dh_m"]] if "de_m" in p else None}
        for i, p in enumerate([*points, *missing])
    ]
    out = {
        "schema": 1,
        "project": "harbour",
        "epoch": "autumn",
        "georef_version": "0.1.0",
        "fingerprint": "4e3f51f784e9",
        "crs": {
            "kind": "local",
            "horizontal": "local",
            "height": None,
            "epoch": None,
            "origin_in_crs": [500.0, 800.0, 0.0],
        },
        "images": {
            "total": len(images),
            "localized": len(posed),
            "rejected": len(images) - len(posed),
            "by_image": images,
        },
        "reference": {
            "source": "estimated",
            "keypoint_sigma": 0.15,
            "position_sigma_m": [0.01] * 3,
            "rotation_sigma_rad": [3e-4] * 3,
            "suspects": [],
            "images": 30,
            "points": 1753,
            "not_observable": "A shift of the whole reference is not observable.",
        },
        "constraints": {
            "kind": "auto-gcps",
            "automatic_gcps": 3860,
            "tie_points": 589,
            "image_observations": 9686,
            "gnss_positions": len(posed),
            "pose_priors": 0,
            "surveyed_control_used": False,
        },
        "check_points": checks(points, missing),
        "check_points_after_pnp": checks(points, missing),
        "control_points": {"used": False, "available": 0, "count": 0, "points": []},
        "gates": {"gnss": {"tested": 9, "rejected": 1, "rejected_ids": ["b7.jpg"]}} if posed else {},
        "variance_components": {
            "gnss": {"observations": 27, "redundancy": 27.0, "factor": 1.3, "factor_sigma": 0.13},
            "control_points": {"observations": 3, "redundancy": 0.5, "factor": None, "factor_sigma": None},
        },
        "adjustment": {"iterations": 3, "converged": True, "image_sigma_scale": 1.24},
        "plan": {
            "frame": "crs",
            "new": [{"image": i["image"], **station} for i in posed],
            "reference": [{"image": "r0.jpg", "position_m": [490.0, 790.0, 2.0], "direction": [0.0, 0.1, -0.99]}],
            "reference_total": 1,
            "check": placed,
            "control": [],
        },
        "timings": {
            "adjust": {"cpu_s": 20.6, "wall_s": 16.5, "peak_memory_mb": 598.0, "computed": 9, "total": 9}
            | {"finished": "2026-11-22T01:40:00+0000"}
        },
        "config": {"adjust": {"gate_probability": 0.999, "gnss": True}, "matching": {"options": {}}},
    }
    return out | changes


NO_RESULT = {
    "adjustment": {"iterations": None, "converged": None, "image_sigma_scale": None},
    "variance_components": {},
}
RELATIVE = [point("K1", "relative", (4, -3, 0)), point("K2", "relative", (1, 1, 12))]
BOTH = [*RELATIVE, point("A1", "absolute", (20, 0, 0)), point("A2", "absolute", (0, 2, 1), sigma=False)]
MISSING = [{"point_id": "K9", "kind": "relative", "mark_count": 1, "reason": "seen in one image only"}]


@pytest.mark.parametrize(
    "given",
    [
        report([localized("a.jpg")], RELATIVE),
        report([localized("a.jpg"), rejected("b.jpg")], BOTH, MISSING),
        report([localized("a.jpg")], []),
        report([localized("a.jpg")], [], MISSING),
        report([rejected("b.jpg")], [], MISSING, **NO_RESULT),
        report(
            [],
            [],
            plan={"frame": "world", "new": [], "reference": [], "reference_total": 0, "check": [], "control": []},
        ),
        report([{**localized("a.jpg"), "adjustment": None}], RELATIVE),
    ],
    ids=["relative", "both kinds", "no check", "none determined", "none localized", "nothing", "not adjusted"],
)
def test_self_contained_page_for_every_mixture(given: dict[str, Any]) -> None:
    before = copy.deepcopy(given)
    page = render_html(given)
    assert given == before
    assert page.lstrip().startswith("<!doctype html>")
    assert page.rstrip().endswith("</html>")
    assert "<script" not in page
    assert not re.search(r"(src|href)\s*=|@import|url\(", page)
    assert set(re.findall(r"https?://[^\"' ]+", page)) <= {"http://www.w3.org/2000/svg"}
    assert "nan" not in re.sub(r"<[^>]*>", " ", page).lower().split()
    assert "estimated minus reference" in page
    assert "A shift of the whole reference is not observable." in page


def test_kinds_are_never_pooled() -> None:
    page = text(render_html(report([localized("a.jpg")], BOTH)))
    absolute, relative = page.index("Absolute check points"), page.index("Relative check points")
    assert absolute < page.index("All absolute check points") < relative < page.index("All relative check points")
    assert "accuracy in the CRS" in page
    assert "no statement of absolute accuracy" in page
    table = page[page.index("All absolute check points") : relative]
    assert "A1" in table
    assert "K1" not in table


def test_points_stand_in_the_order_of_their_error_with_both_stages() -> None:
    given = report([localized("a.jpg")], RELATIVE)
    given["check_points_after_pnp"]["points"] = [point("K1", "relative", (30, 0, 0))]
    page = text(render_html(given))
    table = page[page.index("All relative check points") :]
    assert table.index("K2") < table.index("K1")
    assert re.search(r"K2 \+1\.0 \+1\.0 \+12\.0 12\.1 – 3 0\.25 5\.0 6\.0 7\.0 2\.5", table)
    assert re.search(r"K1 \+4\.0 −3\.0 0\.0 5\.0 30\.0", table)


def test_rejected_images_and_undetermined_points_are_named_with_their_reasons() -> None:
    page = text(render_html(report([localized("a.jpg"), rejected("b.jpg")], RELATIVE, MISSING)))
    assert "1 of 2 localized" in page
    assert "too few matches agree on one pose (few_inliers): 9 of 12" in page
    assert "K9 1 seen in one image only" in page
    assert "1 image rejected, without a pose: b.jpg" in page
    assert "GNSS positions rejected by the gate of the adjustment: b7.jpg" in page


def test_control_stands_apart_and_is_no_accuracy() -> None:
    entry = {"point": "G1", "residual_m": [MM, 2 * MM, -3 * MM], "sigma_m": [5 * MM] * 3, "images": 4}
    control = {"used": True, "available": 4, "count": 1, "points": [entry]}
    control |= {"rmse_e_m": MM, "rmse_n_m": 2 * MM, "rmse_h_m": 3 * MM, "rmse_3d_m": 4 * MM}
    given = report([localized("a.jpg")], RELATIVE, control_points=control)
    given["constraints"]["surveyed_control_used"] = True
    page = text(render_html(given))
    assert "no measure of accuracy" in page
    assert "G1 +1.0 +2.0 −3.0 5.0 5.0 5.0 4" in page


def test_names_from_files_cannot_write_markup() -> None:
    hostile = "<script>alert(1)</script>&\"'"
    given = report([localized(hostile), {**rejected("b"), "detail": hostile}], [point(hostile, "relative", (1, 2, 3))])
    given["project"] = hostile
    assert "<script" not in render_html(given)


def test_large_campaigns_stay_below_a_megabyte_and_say_what_is_left_out() -> None:
    images = [localized(f"day/{i:05d}.jpg") for i in range(5000)] + [rejected("last.jpg")]
    rng = np.random.default_rng(1)
    points = [point(f"K{i}", "relative", tuple(rng.normal(size=3))) for i in range(3000)]
    page = render_html(report(images, points))
    assert len(page.encode()) < 1_000_000
    assert "2600 more are in report.json" in page
    assert "last.jpg" in page  # the rejected are listed first


def test_attention_puts_what_forbids_use_first() -> None:
    given = report([localized("a.jpg")], RELATIVE)
    given["adjustment"] = {"iterations": 30, "converged": False, "image_sigma_scale": 1.0}
    lines = attention(given)
    assert lines[0] == "The adjustment did not converge in 30 iterations: do not use it."
    assert any("All check points are relative" in line for line in lines)
    assert attention(report([rejected("b.jpg")], [], **NO_RESULT))[0].startswith("No image was localized")


def test_plan_vectors_have_the_length_that_the_scale_bar_states() -> None:
    given = report([localized("a.jpg")], [point("K1", "relative", (8, 0, 0)), point("K2", "relative", (0, 4, 0))])
    svg = str(plan_figures(given["plan"], "relative", "ENH")[0])
    lengths = [
        abs(float(b) - float(a)) for a, b in re.findall(r'class="vector" x1="([\d.]+)" y1="[\d.]+" x2="([\d.]+)"', svg)
    ]
    stated = re.search(r">([\d.]+) mm residual \(×([\d\u202f]+)\)<", svg)
    assert stated is not None
    bar = lengths[2]  # after the two residuals
    assert max(lengths[:2]) / 8.0 == pytest.approx(bar / float(stated.group(1)), rel=0.02)


def text(page: str) -> str:
    """What a reader sees: tags out, white space as one blank."""
    bare = re.sub(r"<(style|svg).*?</\1>", " ", page, flags=re.DOTALL)
    bare = re.sub(r"<[^>]*>", " ", bare).replace("&nbsp;", " ")
    return re.sub(r"[ \n\t]+", " ", bare)


def test_reliability_is_shown_and_a_report_without_it_still_is() -> None:
    ranges = {"least": 0.01, "median": 0.02, "p95": 0.05, "greatest": None}
    members = [
        {"name": f"gcp {i}", "position_m": [500.0 + i, 800.0, 1.0], "detectable_m": 0.01 * i} for i in range(1, 9)
    ]
    unchecked = {"name": "gcp 9", "position_m": [509.0, 801.0, 1.0], "detectable_m": None}
    group = {
        "count": 9,
        "unchecked": 1,
        "largest_w": {"name": "gcp 3", "axis": "n", "w": -3.1},
        **{part: dict.fromkeys("enh", ranges) for part in ("redundancy", "detectable_m", "effect_m")},
        "weakest": [{"name": "gcp 9"}],
        "in_plan": [*members, unchecked],
    }
    section = {
        "redundancy": {"observations": 900, "unknowns": 500, "redundancy": 400.0, "sigma0": 1.02}
        | {"image_redundancy_number": {"median": 0.6, "unchecked": 0.0}},
        "groups": {"automatic_gcps": group},
        "rejected_constraints": [
            {"kind": "gnss", "name": "station 7", "statistic": 41.5, "dof": 3},
            *({"kind": "automatic_gcps", "name": f"bad {i}", "statistic": 30.0, "dof": 2} for i in range(40)),
        ],
        "shared_unknowns": [{"name": "focal of left", "value": 1500.25, "sigma": 0.31, "unit": "px"}],
        "correlations": [{"first": "focal of left", "second": "distance of left", "value": 0.987}],
        "correlations_in_all": 1,
        "weak_focals": [{"text": "The focal length of camera 'left' is weak: \nhold it."}],
    }
    page = render_html(report([localized("a.jpg")], RELATIVE, reliability=section))
    said = text(page)
    words = ("redundancy 400", "1.020", "station 7 41.5 3", "focal of left 1 500.25000", "0.9870", "gcp 9", "-3.1")
    plain = said.replace("\N{NARROW NO-BREAK SPACE}", " ").replace("\N{MINUS SIGN}", "-")
    assert [word for word in words if word not in plain] == []
    assert "bad 14" in said
    assert "bad 15" not in said
    assert page.count('class="detectable"') >= 8
    assert page.count('class="unchecked"') == 1
    warnings = attention(report([localized("a.jpg")], RELATIVE, reliability=section))
    assert any("is weak" in line for line in warnings)
    assert any("+0.987" in line for line in warnings)
    assert "Reliability" not in text(render_html(report([localized("a.jpg")], RELATIVE)))
