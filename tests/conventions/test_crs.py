"""georef.crs against PROJ's own topocentric pipeline and projection factors, and the ways in which it refuses."""

from __future__ import annotations

import math
import pickle
import struct
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from pyproj import Proj, Transformer, datadir
from pyproj.transformer import TransformerGroup

from georef.crs import CrsDefinition, WorldFrame, check_area_of_use, choose_origin
from georef.errors import CrsError
from georef.geometry.rigid import Array, rotation_angle

CASTLE = (456583.0, 5421034.0, 178.0)
UTM32 = CrsDefinition("EPSG:25832", "ellipsoidal")

# Definition, origin, half extents of about 10 km.
SYSTEMS = {
    "utm32": (UTM32, CASTLE, (1e4, 1e4, 500.0)),
    "utm47": (CrsDefinition("EPSG:32647", "ellipsoidal"), (661000.0, 1519000.0, -20.0), (1e4, 1e4, 500.0)),
    "northing-first": (CrsDefinition("EPSG:31468", "ellipsoidal"), (4468000.0, 5333000.0, 520.0), (1e4, 1e4, 500.0)),
    "south": (CrsDefinition("EPSG:2193", "ellipsoidal"), (1748000.0, 5427000.0, 30.0), (1e4, 1e4, 500.0)),
    "not-conformal": (CrsDefinition("EPSG:3035", "ellipsoidal"), (2700000.0, 1950000.0, 30.0), (1e4, 1e4, 500.0)),
    "geographic-2d": (CrsDefinition("EPSG:4326", "ellipsoidal"), (8.4, 48.9, 178.0), (0.13, 0.09, 500.0)),
    "geographic-3d": (CrsDefinition("EPSG:4979"), (-70.6, -33.4, 600.0), (0.1, 0.09, 9000.0)),
    "geocentric": (CrsDefinition("EPSG:4978"), (4151000.0, 613500.0, 4786000.0), (1e4, 1e4, 1e4)),
    "moving": (CrsDefinition("EPSG:9989", epoch=2021.5), (8.4, 48.9, 178.0), (0.13, 0.09, 500.0)),
    "local": (CrsDefinition("local"), (1000.0, 2000.0, 100.0), (1e4, 1e4, 500.0)),
}
PROJECTED = ["utm32", "utm47", "northing-first", "south", "not-conformal"]


@pytest.fixture(params=SYSTEMS)
def system(request: pytest.FixtureRequest) -> tuple[WorldFrame, Array]:
    """A frame and 200 points within about 10 km of its origin."""
    return frame_and_points(request.param)


def frame_and_points(name: str) -> tuple[WorldFrame, Array]:
    definition, origin, extent = SYSTEMS[name]
    offsets = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 3)) * extent
    return WorldFrame.create(definition, origin), np.asarray(origin) + offsets


def refused(definition: CrsDefinition, origin: tuple[float, ...] = CASTLE) -> str:
    with pytest.raises(CrsError) as caught:
        WorldFrame.create(definition, origin)
    message = str(caught.value)
    assert len(message.splitlines()) == 3
    assert message.splitlines()[1].startswith("Expected ")
    return message


# --- positions ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "steps"), [
    ("utm32", "+step +inv +proj=utm +zone=32 +ellps=GRS80"),
    ("utm47", "+step +inv +proj=utm +zone=47 +ellps=WGS84"),
    ("northing-first", "+step +inv +proj=tmerc +lon_0=12 +x_0=4500000 +ellps=bessel"),
    ("geographic-3d", "+step +proj=unitconvert +xy_in=deg +xy_out=rad"),
])  # fmt: skip
def test_world_is_projs_topocentric_frame(name: str, steps: str) -> None:
    frame, points = frame_and_points(name)
    ellipsoid = {"northing-first": "bessel", "utm32": "GRS80"}.get(name, "WGS84")
    to_ecef = Transformer.from_pipeline(f"+proj=pipeline {steps} +step +proj=cart +ellps={ellipsoid}")
    x, y, z = to_ecef.transform(*frame.origin_in_crs)
    topocentric = f"+step +proj=topocentric +ellps={ellipsoid} +X_0={x!r} +Y_0={y!r} +Z_0={z!r}"
    pipeline = Transformer.from_pipeline(f"+proj=pipeline {steps} +step +proj=cart +ellps={ellipsoid} {topocentric}")
    expected = np.column_stack(pipeline.transform(*points.T))
    np.testing.assert_allclose(frame.world_from_crs(points), expected, atol=2e-8)


def test_geocentric_and_geographic_agree() -> None:
    """The same place, declared in two ways, gives the same world."""
    geographic, points = frame_and_points("geographic-3d")
    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    geocentric = WorldFrame.create(CrsDefinition("EPSG:4978"), to_ecef.transform(*geographic.origin_in_crs))
    in_ecef = np.column_stack(to_ecef.transform(*points.T))
    np.testing.assert_allclose(geocentric.world_from_crs(in_ecef), geographic.world_from_crs(points), atol=1e-7)


def test_round_trip(system: tuple[WorldFrame, Array]) -> None:
    frame, points = system
    world = frame.world_from_crs(points)
    again = frame.crs_from_world(world)
    np.testing.assert_allclose(frame.world_from_crs(again), world, atol=1e-6)
    metres = 111e3 if frame.describe()["kind"] == "geographic" else 1.0
    np.testing.assert_allclose((again - points) * [metres, metres, 1.0], 0.0, atol=1e-6)
    np.testing.assert_allclose(frame.world_from_crs(frame.origin_in_crs[None]), 0.0, atol=1e-9)
    assert frame.world_from_crs(np.zeros((0, 3))).shape == (0, 3)


def test_world_is_metric_and_level() -> None:
    """1 km on the grid is 1000.4 m; and the ground curves away from the horizon of the origin by d^2 / 2R."""
    frame = WorldFrame.create(UTM32, CASTLE)
    world = frame.world_from_crs(np.add(CASTLE, [[1000.0, 0, 0], [0, 10000.0, 0]]))
    assert np.linalg.norm(world[0]) == pytest.approx(1000.0 / 0.9996231 * (1 + 178 / 6.385e6), abs=1e-3)
    assert world[1, 2] == pytest.approx(-(10004.0**2) / (2 * 6.378e6), rel=3e-3)


def test_geographic_longitudes_across_the_antimeridian() -> None:
    frame = WorldFrame.create(CrsDefinition("EPSG:4979"), (179.999, -17.0, 50.0))
    east = frame.world_from_crs([[-179.999, -17.0, 50.0], [180.001, -17.0, 50.0]])
    np.testing.assert_allclose(east[0], east[1], atol=1e-7)
    assert east[0, 0] == pytest.approx(213.0, abs=1.0)
    origin = choose_origin(frame.definition, [[179.999, -17.0, 50.0], [-179.997, -17.0, 51.0]])
    np.testing.assert_allclose(origin, [-179.999, -17.0, 50.0])


# --- axes -----------------------------------------------------------------------------------------


def test_scale_and_convergence_at_castle() -> None:
    report = WorldFrame.create(UTM32, CASTLE).describe()
    factors = Proj("EPSG:25832").get_factors(report["origin_longitude_deg"], report["origin_latitude_deg"])
    assert report["grid_convergence_deg"] == pytest.approx(-0.447, abs=5e-4)
    assert report["grid_convergence_deg"] == pytest.approx(factors.meridian_convergence, abs=1e-7)
    assert report["grid_scale"] == pytest.approx(factors.meridional_scale, abs=1e-9)
    assert report["horizontal_code"] == "EPSG:25832"
    assert report["horizontal_name"] == "ETRS89 / UTM zone 32N"


@pytest.mark.parametrize("name", PROJECTED)
def test_convergence_is_that_of_projs_factors(name: str) -> None:
    frame, _ = frame_and_points(name)
    report = frame.describe()
    factors = Proj(frame.definition.horizontal).get_factors(
        report["origin_longitude_deg"], report["origin_latitude_deg"]
    )
    jacobian = np.array([[factors.dx_dlam, factors.dx_dphi], [factors.dy_dlam, factors.dy_dphi]])
    assert np.linalg.det(jacobian) > 0
    # Where the projection is not conformal the nearest rotation lies between the turns of the two axes.
    tolerance = 1e-6 if name != "not-conformal" else factors.angular_distortion
    assert report["grid_convergence_deg"] == pytest.approx(factors.meridian_convergence, abs=tolerance)


def test_axes_are_rotations(system: tuple[WorldFrame, Array]) -> None:
    frame, points = system
    axes = frame.crs_axes_from_world(points)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.tile(np.eye(3), (len(points), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-12)


@pytest.mark.parametrize("name", [*PROJECTED, "geocentric", "local"])
def test_axes_by_differences(name: str) -> None:
    """World differences of neighbours, turned to CRS axes, are their CRS differences, up to scale of the grid."""
    frame, points = frame_and_points(name)
    axes = frame.crs_axes_from_world(points)
    for k, step in enumerate(np.eye(3) * 2.0):
        ahead, behind = frame.world_from_crs(points + step), frame.world_from_crs(points - step)
        turned = np.einsum("nij,nj->ni", axes, (ahead - behind) / 4.0)
        across = np.linalg.norm(np.delete(turned, k, axis=1), axis=1)
        conformal = name != "not-conformal"
        assert across.max() < (2e-8 if conformal else 0.02)
        np.testing.assert_allclose(turned[:, k], 1.0, atol=2e-3 if conformal else 0.02)


def test_axes_of_geographic_are_east_north_up() -> None:
    frame, points = frame_and_points("geographic-2d")
    axes = frame.crs_axes_from_world(points)
    for k, step in enumerate(np.diag([1e-6, 1e-6, 0.1])):
        moved = frame.world_from_crs(points + step) - frame.world_from_crs(points - step)
        moved = np.einsum("nij,nj->ni", axes, moved / np.linalg.norm(moved, axis=1, keepdims=True))
        np.testing.assert_allclose(moved, np.tile(np.eye(3)[k], (len(points), 1)), atol=1e-6)


def test_nearest_rotation_where_not_conformal() -> None:
    """LAEA far from its centre: grid east and grid north are each off by the same angle, in opposite senses."""
    frame, points = frame_and_points("not-conformal")
    point = points[:1]
    axes = frame.crs_axes_from_world(point)[0]
    differences = [frame.world_from_crs(point + s) - frame.world_from_crs(point - s) for s in np.eye(3)[:2]]
    grid_east, grid_north = ((axes @ (difference[0] / 2.0)) for difference in differences)
    assert grid_east[1] == pytest.approx(grid_north[0], abs=1e-8)
    assert abs(grid_east[1]) > 1e-3


def test_normal_turns_one_arcsecond_in_31_metres() -> None:
    frame = WorldFrame.create(UTM32, CASTLE)
    up = frame.crs_axes_from_world(np.add(CASTLE, [[0, 0, 0], [0, 1000.0, 0]]))[:, 2]
    angle_arcsec = math.degrees(math.acos(min(1.0, float(up[0] @ up[1])))) * 3600
    assert 1000.0 / angle_arcsec == pytest.approx(30.9, abs=0.1)
    np.testing.assert_allclose(up[0], [0, 0, 1], atol=1e-12)


def test_origin_axes_turn_by_the_convergence_only() -> None:
    frame = WorldFrame.create(UTM32, CASTLE)
    axes = frame.crs_axes_from_world([CASTLE])[0]
    assert math.degrees(rotation_angle(axes)) == pytest.approx(0.447, abs=5e-4)
    # West of the central meridian grid north points west of true north: true north has a positive easting.
    assert axes[0, 1] > 0


# --- covariances ----------------------------------------------------------------------------------


def test_covariances_agree_with_monte_carlo() -> None:
    frame, points = frame_and_points("not-conformal")
    point, cov = points[:1], np.diag([0.04, 0.0025, 0.25])
    noise = np.random.default_rng(2).multivariate_normal(np.zeros(3), cov, 50_000)
    in_world = frame.world_from_crs(point + noise)
    predicted = frame.world_cov_from_crs(point, cov[None])[0]
    np.testing.assert_allclose(np.cov(in_world.T), predicted, atol=0.03 * 0.25)
    assert abs(predicted[0, 1]) > 0.005  # a convergence of some 17 degrees: not diagonal any more


def test_covariances_round_trip(system: tuple[WorldFrame, Array]) -> None:
    frame, points = system
    roots = np.random.default_rng(3).normal(size=(len(points), 3, 3))
    covs = roots @ roots.transpose(0, 2, 1)
    in_world = frame.world_cov_from_crs(points, covs)
    np.testing.assert_allclose(frame.crs_cov_from_world(points, in_world), covs, atol=1e-12)
    np.testing.assert_allclose(np.linalg.eigvalsh(in_world), np.linalg.eigvalsh(covs), atol=1e-12)


def test_covariances_must_match_the_points() -> None:
    frame = WorldFrame.create(UTM32, CASTLE)
    with pytest.raises(CrsError, match=r"shape \(3, 3\)"):
        frame.world_cov_from_crs([CASTLE], np.eye(3))
    with pytest.raises(CrsError, match="finite"):
        frame.world_cov_from_crs([CASTLE], np.full((1, 3, 3), np.nan))


# --- heights --------------------------------------------------------------------------------------


def undulation(lon: float | Array, lat: float | Array) -> float | Array:
    return 40.0 + 0.1 * lat + 0.05 * lon


@pytest.fixture
def egm96(tmp_path: Path) -> Iterator[None]:
    """A made-up worldwide geoid, a plane in longitude and latitude, under the name of EGM96's grid."""
    lat, lon = np.arange(-90.0, 91.0)[:, None], np.arange(-180.0, 181.0)[None]
    header = struct.pack(">4d2i", -90.0, -180.0, 1.0, 1.0, 181, 361)
    (tmp_path / "egm96_15.gtx").write_bytes(header + np.asarray(undulation(lon, lat)).astype(">f4").tobytes())
    before = datadir.get_data_dir()
    datadir.append_data_dir(str(tmp_path))
    yield
    datadir.set_data_dir(before)


@pytest.mark.parametrize(
    "definition", [CrsDefinition("EPSG:25832", "EPSG:7837"), CrsDefinition("EPSG:25832+7837")], ids=["two", "compound"]
)
def test_missing_geoid_grid_is_named(definition: CrsDefinition) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = TransformerGroup("EPSG:25832+7837", "EPSG:4937", always_xy=True, allow_ballpark=False)
    if group.best_available:
        pytest.skip("de_bkg_gcg2016.tif is installed here")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        message = refused(definition)
    assert "'de_bkg_gcg2016.tif'" in message
    assert "pyproj sync --file de_bkg_gcg2016.tif" in message
    assert "height = 'ellipsoidal'" in message
    assert datadir.get_data_dir() in message


@pytest.mark.usefixtures("egm96")
@pytest.mark.parametrize(
    "definition", [CrsDefinition("EPSG:25832", "EPSG:5773"), CrsDefinition("EPSG:25832+5773")], ids=["two", "compound"]
)
def test_installed_geoid_grid_is_applied(definition: CrsDefinition) -> None:
    frame = WorldFrame.create(definition, CASTLE)
    report = frame.describe()
    lon, lat = report["origin_longitude_deg"], report["origin_latitude_deg"]
    assert report["origin_ellipsoidal_height_m"] == pytest.approx(178.0 + undulation(lon, lat), abs=1e-4)
    assert report["height_name"] == "EGM96 height"
    assert report["height_accuracy_m"] > 0
    ellipsoidal = WorldFrame.create(UTM32, (*CASTLE[:2], report["origin_ellipsoidal_height_m"]))
    points = np.array(CASTLE) + np.random.default_rng(4).uniform(-1e4, 1e4, (50, 3)) * [1, 1, 0.02]
    world = frame.world_from_crs(points)
    np.testing.assert_allclose(frame.crs_from_world(world), points, atol=1e-6)
    lonlat = np.column_stack(Proj("EPSG:25832")(*points[:, :2].T, inverse=True))
    raised = points + np.array([0.0, 0.0, 1.0]) * np.asarray(undulation(lonlat[:, 0], lonlat[:, 1]))[:, None]
    np.testing.assert_allclose(world, ellipsoidal.world_from_crs(raised), atol=1e-4)


@pytest.mark.usefixtures("egm96")
def test_geoid_of_another_datum_is_inverted_exactly() -> None:
    """EGM96 is on WGS 84, the coordinates on ED50: PROJ alone comes back with other heights (by 2e-6 m)."""
    frame = WorldFrame.create(CrsDefinition("EPSG:23032", "EPSG:5773"), CASTLE)
    points = frame.origin_in_crs + np.random.default_rng(5).uniform(-1e4, 1e4, (50, 3)) * [1, 1, 0.02]
    np.testing.assert_allclose(frame.crs_from_world(frame.world_from_crs(points)), points, atol=1e-7)


def test_height_without_any_geoid_model_is_refused() -> None:
    message = refused(CrsDefinition("EPSG:25833", "EPSG:5195"), (400000.0, 5040000.0, 10.0))
    assert "no exact way" in message


@pytest.mark.parametrize(("definition", "part"), [
    (CrsDefinition("EPSG:25832"), "no height"),
    (CrsDefinition("EPSG:4326"), "no height"),
    (CrsDefinition("EPSG:25832+7837", "EPSG:7837"), "has a height already"),
    (CrsDefinition("EPSG:25832+7837", "ellipsoidal"), "has a height already"),
    (CrsDefinition("EPSG:4979", "ellipsoidal"), "has a height already"),
    (CrsDefinition("EPSG:4978", "ellipsoidal"), "has a height already"),
    (CrsDefinition("EPSG:25832", "EPSG:4979"), "Geographic 3D"),
    (CrsDefinition("EPSG:25832", "EPSG:5972"), "Compound"),
    (CrsDefinition("EPSG:25832", "Ellipsoidal"), "not known"),
    (CrsDefinition("EPSG:25832", "EPSG:5831"), "down"),
    (CrsDefinition("EPSG:25832", "EPSG:6360"), "US survey foot"),
    (CrsDefinition("EPSG:7837"), "Vertical CRS"),
    (CrsDefinition("local", "ellipsoidal"), "local"),
])  # fmt: skip
def test_unclear_height_is_refused(definition: CrsDefinition, part: str) -> None:
    assert part in refused(definition)


# --- what is refused besides ----------------------------------------------------------------------


def test_unknown_code() -> None:
    message = refused(CrsDefinition("EPSG:999999", "ellipsoidal"))
    assert "EPSG:999999" in message
    assert "https://epsg.org" in message


@pytest.mark.parametrize(("code", "part"), [
    ("EPSG:2263", "US survey foot"),
    ("EPSG:2053", "Westing (west"),
    ("EPSG:3031", "Northing (north"),
    ("EPSG:27572", "Greenwich"),
])  # fmt: skip
def test_axes_and_units(code: str, part: str) -> None:
    assert part in refused(CrsDefinition(code, "ellipsoidal"))


def test_moving_frames_need_an_epoch() -> None:
    assert "no epoch" in refused(CrsDefinition("EPSG:9989"), (8.4, 48.9, 178.0))
    assert "no year" in refused(CrsDefinition("EPSG:9989", epoch=math.nan), (8.4, 48.9, 178.0))
    assert WorldFrame.create(CrsDefinition("EPSG:9989", epoch=2021.5), (8.4, 48.9, 178.0)).describe()["epoch"] == 2021.5


def test_swapped_axes_are_recognised() -> None:
    points = np.add(CASTLE, [[0.0, 0, 0], [500.0, 0, 0]])
    check_area_of_use(UTM32, points)
    with pytest.raises(CrsError, match="easting and northing are probably swapped"):
        check_area_of_use(UTM32, points[:, [1, 0, 2]])
    with pytest.raises(CrsError, match="longitude and latitude are probably swapped"):
        check_area_of_use(CrsDefinition("EPSG:4937"), [[65.0, 25.0, 100.0]])


def test_outside_area_of_use() -> None:
    """Longitude 60 in UTM 32 gives plausible numbers, but not in its area."""
    far = Proj("EPSG:25832")(60.0, 48.0)
    with pytest.raises(CrsError) as caught:
        check_area_of_use(UTM32, [CASTLE, (*far, 100.0), (*far, 101.0)])
    message = str(caught.value)
    assert "Point 1" in message
    assert "longitude 60.0000, latitude 48.0000" in message
    assert "2 of 3" in message
    assert "longitude 6 to 12.01" in message
    assert "swapped" not in message
    with pytest.raises(CrsError, match="outside the area of use"):  # zone 3 read as zone 4
        check_area_of_use(CrsDefinition("EPSG:31468", "ellipsoidal"), [[3456583.0, 5421034.0, 178.0]])
    with pytest.raises(CrsError, match="latitude 91"):
        check_area_of_use(CrsDefinition("EPSG:4979"), [[10.0, 91.0, 0.0]])


def test_just_over_the_border_of_a_zone_is_no_error() -> None:
    over = Proj("EPSG:25832")(12.6, 48.0)
    check_area_of_use(UTM32, [(*over, 400.0)])


def test_area_of_the_height_is_checked_too() -> None:
    """DHHN2016 is for Germany; Rome lies in UTM zone 32/33."""
    with pytest.raises(CrsError, match="Germany"):
        check_area_of_use(CrsDefinition("EPSG:25832", "EPSG:7837"), [[780000.0, 4640000.0, 50.0]])


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_not_finite(bad: float) -> None:
    frame = WorldFrame.create(UTM32, CASTLE)
    points = [CASTLE, (bad, *CASTLE[1:])]
    for refuse in (frame.world_from_crs, frame.crs_from_world, frame.crs_axes_from_world):
        with pytest.raises(CrsError, match=r"\[1\] is"):
            refuse(points)
    with pytest.raises(CrsError, match=r"\[1\] is"):
        choose_origin(UTM32, points)


def test_shape() -> None:
    with pytest.raises(CrsError, match=r"shape \(2,\)"):
        WorldFrame.create(UTM32, CASTLE).world_from_crs(CASTLE[:2])


def test_choose_origin() -> None:
    points = np.add(CASTLE, [[0.4, 10.2, 1.0], [1.0, -9.0, 2.0]])
    np.testing.assert_array_equal(choose_origin(UTM32, points), [456584.0, 5421035.0, 180.0])
    np.testing.assert_array_equal(choose_origin(UTM32, points[::-1]), [456584.0, 5421035.0, 180.0])
    with pytest.raises(CrsError, match="no points"):
        choose_origin(UTM32, np.zeros((0, 3)))


def test_frames_travel_to_workers(system: tuple[WorldFrame, Array]) -> None:
    """Pickled to another process, or shared by threads: the same numbers."""
    frame, points = system
    world = frame.world_from_crs(points)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(frame)).world_from_crs(points), world)
    with ThreadPoolExecutor(2) as pool:
        for result in pool.map(frame.world_from_crs, [points] * 4):
            np.testing.assert_array_equal(result, world)


def test_crs_without_code_or_area() -> None:
    """A transverse Mercator of a site, with a shift to WGS 84 that must not be applied."""
    text = "+proj=tmerc +lat_0=48 +lon_0=9 +k=1.0001 +x_0=5000 +y_0=-2000 +ellps=bessel +type=crs"
    plain = WorldFrame.create(CrsDefinition(text, "ellipsoidal"), (5100.0, -1900.0, 300.0))
    shifted = WorldFrame.create(
        CrsDefinition(f"{text} +towgs84=598.1,73.7,418.2,0,0,0,0", "ellipsoidal"), (5100, -1900, 300)
    )
    points = np.add(plain.origin_in_crs, [[700.0, 20.0, 3.0]])
    np.testing.assert_array_equal(shifted.world_from_crs(points), plain.world_from_crs(points))
    assert plain.describe()["horizontal_code"] is None
    assert plain.describe()["grid_scale"] == pytest.approx(1.0001, abs=1e-8)
