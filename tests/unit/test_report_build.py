"""What the report is built from: axes of the CRS at images, plans, words and numbers."""

from typing import Any

import numpy as np
import pytest

from georef.crs import CrsDefinition, WorldFrame
from georef.evaluation.check_points import evaluate_check_points
from georef.evaluation.forward_intersection import PosedImages
from georef.geometry.camera import Camera, project
from georef.geometry.rigid import Rigid3
from georef.report.build import ReportInput, build_report
from georef.report.html import millimetres, number, signed_mm, span
from georef.report.plan import Placed, nearest, plan_section
from georef.report.svg import Drawing, round_down, round_up, short, ticks
from georef.report.wording import component_reading, nees_verdict
from georef.types.constraints import CheckKind, CheckPoint, ControlPoint, Mark
from georef.types.results import Localized, Rejected, RejectReason

CAMERA = Camera("cam", 3000, 2000, 2700.0, 2700.0, 1500.0, 1000.0)
NORTHWARDS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # world_from_cam: looks north, y down
POSES = {f"n{i}.jpg": Rigid3(NORTHWARDS, np.array([4.0 * i, 0.0, 2.0])) for i in range(3)}
SHIFT = np.array([0.003, -0.002, 0.001])
COV = np.diag([1e-6, 4e-6, 9e-6])
UTM = WorldFrame.create(CrsDefinition("EPSG:25832", "ellipsoidal"), [320000.0, 5421026.0, 178.0])  # 1.8 deg convergence
GEOGRAPHIC = WorldFrame.create(CrsDefinition("EPSG:4258", "ellipsoidal"), [8.4, 48.94, 178.0])


def checked(name: str, kind: CheckKind, at: list[float]) -> CheckPoint:
    """A check point whose marks intersect SHIFT away from its reference coordinates."""
    point = np.array(at)
    pixels = {n: project(CAMERA, pose.inverse().apply(point + SHIFT)[None])[0] for n, pose in POSES.items()}
    return CheckPoint(name, kind, point, COV, tuple(Mark(n, pixel, 0.5) for n, pixel in pixels.items()))


def placed_in(world: WorldFrame, check: list[CheckPoint]) -> Placed:
    return Placed(
        world=world,
        new=POSES,
        position_covs=dict.fromkeys(POSES, COV),
        gnss_covs=dict.fromkeys(POSES, np.diag([4.0, 1.0, 9.0])),
        reference={f"r{i}.jpg": Rigid3(NORTHWARDS, np.array([float(i), -5.0, 2.0])) for i in range(5)},
        check=check,
        control=[ControlPoint("G1", np.array([1.0, 30.0, 2.0]), COV, ())],
    )


def given_in(world: WorldFrame, check: list[CheckPoint], **changes: Any) -> ReportInput:
    joint = lambda indices: 1e-6 * np.eye(6 * len(indices))  # noqa: E731
    posed = PosedImages(tuple(POSES), (CAMERA,) * 3, tuple(POSES.values()), joint)
    kinds = [kind for kind in CheckKind if any(p.kind is kind for p in check)]
    found = {kind: evaluate_check_points([p for p in check if p.kind is kind], posed) for kind in kinds}
    none = np.zeros(0, np.int64)
    outcomes = [
        Localized(n, pose, 1e-6 * np.eye(6), 1e-6 * np.eye(6), 99, 1.0, (), np.zeros((0, 3)), none)
        for n, pose in POSES.items()
    ]
    used = {n: {"observations": 9, "residual_rms_px": 0.4, "gnss_residual_m": [0.0, 1.0, 0.5]} for n in POSES}
    points = [p.point_in_world for p in (*check, *placed_in(world, check).control)]
    turns = world.crs_axes_from_world(world.crs_from_world(np.array(points)))
    values: dict[str, Any] = {
        "project": "p",
        "epoch": "e",
        "version": "0",
        "fingerprint": "f",
        "config": {"adjust": {"constraints": "auto-gcps"}},
        "world": world.describe(),
        "outcomes": (*outcomes, Rejected("n9.jpg", RejectReason.FEW_MATCHES, "3 of 20")),
        "adjustment": {"images_used": used, "control": [{"point": "G1", "residual_m": [0.0, 0.01, 0.0]}]},
        "network": {},
        "check_before": found,
        "check_after": found,
        "axes_from_world": dict(zip([*[p.point_id for p in check], "G1"], turns, strict=True)),
        "placed": placed_in(world, check),
        "surveyed_control": True,
        "control_ids": ("G1",),
        "timings": {},
    }
    return ReportInput(**(values | changes))


BOTH = [checked("A1", CheckKind.ABSOLUTE, [2.0, 30.0, 4.0]), checked("K1", CheckKind.RELATIVE, [5.0, 25.0, 1.0])]


def test_residuals_and_sigmas_are_along_the_axes_of_the_crs() -> None:
    report = build_report(given_in(UTM, BOTH))
    convergence = np.radians(report["crs"]["grid_convergence_deg"])
    assert abs(convergence) > 0.03
    image = report["images"]["by_image"][0]["adjustment"]
    np.testing.assert_allclose(image["gnss_residual_m"], [-np.sin(convergence), np.cos(convergence), 0.5], atol=2e-5)
    np.testing.assert_allclose(
        image["gnss_sigma_m"][0] ** 2, 4 * np.cos(convergence) ** 2 + np.sin(convergence) ** 2, rtol=1e-4
    )
    np.testing.assert_allclose(image["sigma_m"], [0.001, 0.002, 0.003], rtol=0.01)
    point = report["check_points"]["points"][0]
    east = np.cos(convergence) * SHIFT[0] - np.sin(convergence) * SHIFT[1]
    assert point["de_m"] == pytest.approx(east, abs=1e-7)
    on_plan = report["plan"]["check"][0]
    np.testing.assert_allclose(on_plan["residual_m"], [point["de_m"], point["dn_m"], point["dh_m"]], atol=1e-6)


def test_contract_of_the_report() -> None:
    report = build_report(given_in(UTM, BOTH))
    assert {key: report["images"][key] for key in ("total", "localized", "rejected")} == {
        "total": 4,
        "localized": 3,
        "rejected": 1,
    }
    check = report["check_points"]
    assert check["kind"] == "absolute"  # the first levels repeat the absolute kind, not a mixture
    assert check["count"] == 1
    assert {"rmse_e_m", "rmse_n_m", "rmse_h_m", "rmse_3d_m"} <= check.keys()
    assert check["by_kind"].keys() == {"absolute", "relative"}
    assert {"control_points", "gates", "variance_components", "timings"} <= report.keys()


def test_nothing_localized_and_no_points() -> None:
    bare = Placed(UTM, {}, {}, {}, {}, [], [])
    outcomes = (Rejected("n9.jpg", RejectReason.UNREADABLE, "cut short"),)
    report = build_report(
        given_in(UTM, [], outcomes=outcomes, adjustment={}, check_before={}, check_after={}, placed=bare)
    )
    assert report["images"]["by_image"][0]["reason"] == "unreadable"
    assert report["check_points"]["count"] == 0
    assert report["plan"] == {
        "frame": "crs",
        "new": [],
        "reference": [],
        "reference_total": 0,
        "check": [],
        "control": [],
    }


def test_plan_is_metric_in_every_kind_of_crs() -> None:
    """In grid coordinates where they are metric, else in the topocentric frame."""
    residual = {"A1": SHIFT}
    grid = plan_section(placed_in(UTM, BOTH), residual, {})
    np.testing.assert_allclose(grid["new"][0]["position_m"], [320000.0, 5421026.0, 180.0], atol=1e-3)
    world = plan_section(placed_in(GEOGRAPHIC, BOTH), residual, {})
    assert (grid["frame"], world["frame"]) == ("crs", "world")
    assert world["new"][1]["position_m"] == [4.0, 0.0, 2.0]
    assert world["new"][1]["direction"] == [0.0, 1.0, 0.0]
    assert [p["residual_m"] for p in world["check"]] == [SHIFT.tolist(), None]


def test_nearest_keeps_the_order_and_bounds_the_number() -> None:
    line = np.column_stack([np.arange(10.0), np.zeros(10), np.zeros(10)])
    assert nearest(line, np.array([[7.1, 0, 0]]), 3).tolist() == [6, 7, 8]
    assert nearest(line, np.zeros((0, 3)), 4).tolist() == [0, 3, 6, 9]
    assert len(nearest(line, line[:1], 99)) == 10


def nees(ratio: float | None) -> dict[str, Any]:
    inside = None if ratio is None else 0.6 <= ratio <= 1.5
    return {"mean_ratio": ratio, "interval_95": None if ratio is None else [0.6, 1.5], "consistent": inside}


def test_verdicts() -> None:
    assert nees_verdict(nees(1.1)).level == "ok"
    assert "too small" in nees_verdict(nees(4.0)).title
    assert "2.0 times what the sigmas predict" in nees_verdict(nees(4.0)).text
    assert "too large" in nees_verdict(nees(0.1)).title
    assert nees_verdict(nees(None)).level == "none"
    assert component_reading({"factor": 1.3, "factor_sigma": 0.1}) == "residuals 30 % larger than stated"
    assert component_reading({"factor": 0.965, "factor_sigma": 0.13}) == "as stated"
    assert component_reading({"factor": None, "factor_sigma": None}) == "redundancy too small to tell"


def test_numbers() -> None:
    assert number(1234567.891, 1) == "1\u202f234\u202f567.9"
    assert number(-0.04, 1) == "0.0"
    assert number(-2.5) == "\N{MINUS SIGN}2.5"
    assert number(None) == "–"
    assert millimetres(0.00451) == "4.5"
    assert signed_mm(0.0021) == "+2.1"
    assert signed_mm(0.00001) == "0.0"
    assert span([0.0037, 0.0058]) == "3.7 to 5.8"
    assert span(None) == "–"
    assert (round_down(0.0299), round_down(5.0), round_up(0.021), round_up(5.0)) == pytest.approx(
        (0.02, 5.0, 0.05, 5.0)
    )
    assert ticks(-3.0, 11.0, 5) == pytest.approx([0.0, 5.0, 10.0])
    assert short(5421040.0) == "5\u202f421\u202f040"
    drawing = Drawing(10, 10, 'a "label"')
    drawing.text((1, 1), "<b>")
    assert "&lt;b&gt;" in drawing.render()
