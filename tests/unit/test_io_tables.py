"""Tables as surveyors send them: encodings, delimiters, decimal signs, names, declarations."""

from __future__ import annotations

import logging
import time
from pathlib import Path

import numpy as np
import pytest

from georef.errors import InputError
from georef.io.declarations import (
    check_declared_angles,
    check_declared_crs,
    check_declared_height,
    parse_declarations,
)
from georef.io.tables import Table, TableFormat, read_table


def table_of(tmp_path: Path, content: str | bytes, **options) -> Table:
    path = tmp_path / "table.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_table(path, **options)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252", "latin-1", "utf-32"])
def test_encodings(tmp_path: Path, encoding: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        table = table_of(tmp_path, "# Höhe über Grund\nimage,x\nStraße_ä.jpg,1.5\n".encode(encoding))
    assert table.header == ("image", "x")
    assert table.ids("image") == ("Straße_ä.jpg",)
    assert table.numbers("x").tolist() == [1.5]
    assert ("not UTF-8" in caplog.text) == (encoding in ("cp1252", "latin-1"))


def test_stated_encoding(tmp_path: Path) -> None:
    content = "image\nЁ.jpg\n".encode("cp1251")
    assert table_of(tmp_path, content, table_format=TableFormat(encoding="cp1251")).ids("image") == ("Ё.jpg",)


@pytest.mark.parametrize(
    ("text", "decimal"),
    [
        ("image,x,y\na,1.5,-2e3\nb,0.25,7\n", "."),
        ("image, x, y\na, 1.5, -2e3\nb, 0.25, 7\n", "."),
        ("image;x;y\na;1.5;-2e3\nb;0.25;7\n", "."),
        ("image;x;y\na;1,5;-2e3\nb;0,25;7\n", ","),
        ("image\tx\ty\na\t1,5\t-2e3\nb\t0,25\t7\n", ","),
        ("image\tx\ty\na\t1.5\t-2000.0\nb\t0.25\t7\n", "."),
        ("image  x   y\na   1.5  -2e3\nb 0.25   7\n", "."),
        ("image x y\na 1,5 -2e3\nb 0,25 7\n", ","),
        ('"image","x","y"\r\n"a","1.5","-2e3"\r\n"b","0.25","7"\r\n', "."),
        ("image;x;y;;\na;1,5;-2e3;;\n;;;;\nb;0,25;7;;\n", ","),
    ],
)
def test_delimiters_and_decimals(tmp_path: Path, text: str, decimal: str) -> None:
    table = table_of(tmp_path, text)
    assert table.decimal == decimal
    assert table.ids("image") == ("a", "b")
    np.testing.assert_array_equal(table.stack(("x", "y")), [[1.5, -2000.0], [0.25, 7.0]])


def test_a_delimiter_within_quotes_is_text(tmp_path: Path) -> None:
    table = table_of(tmp_path, '"image";"x, m";"y"\n"a";1.5;2.5\n')
    assert table.header == ("image", "x, m", "y")
    assert table.numbers("x, m").tolist() == [1.5]


def test_stated_format_overrides(tmp_path: Path) -> None:
    table = table_of(tmp_path, "image|x\na|456,583\n", table_format=TableFormat(delimiter="|", decimal=","))
    assert table.numbers("x").tolist() == [456.583]
    table = table_of(tmp_path, 'image,x\na,"1,5"\n', table_format=TableFormat(decimal=","))
    assert table.numbers("x").tolist() == [1.5]
    table = table_of(tmp_path, "image\tx\na b\t1\n", table_format=TableFormat(delimiter="tab"))
    assert table.ids("image") == ("a b",)
    with pytest.raises(InputError, match="a decimal comma and no thousands"):
        table_of(tmp_path, "image;x\na;1.234\n", table_format=TableFormat(decimal=",")).numbers("x")
    with pytest.raises(InputError, match="its comma is a decimal sign"):
        table_of(tmp_path, 'image,x\na,"1,5"\n').numbers("x")


def test_commas_in_text_are_no_decimals(tmp_path: Path) -> None:
    table = table_of(tmp_path, "image;remark;x\na;at 3,5 m, left;1.5\n")
    assert table.decimal == "."
    assert table.text("remark") == ("at 3,5 m, left",)


def test_rows_are_physical_lines(tmp_path: Path) -> None:
    table = table_of(tmp_path, "# one\r\n\r\nimage,x\r\na,1\r\n# two\r\n\r\nb,2")
    assert table.rows.tolist() == [4, 7]
    assert table.take([1]).rows.tolist() == [7]
    assert table.take([1]).ids("image") == ("b",)
    assert len(table.take([])) == 0


def test_names_and_mapping(tmp_path: Path) -> None:
    text = "Name, EASTING ,AccHor\nP1,7,0.02\n"
    table = table_of(tmp_path, text, columns={"point": "name", "sigma_e": "acchor", "easting": "X"})
    assert table.has("point", "easting", "sigma_e")
    assert not table.has("northing")
    assert table.ids("point") == ("P1",)
    assert table.numbers("Easting").tolist() == [7.0]  # mapped to a column that is not there: stands for itself
    assert table.numbers("sigma_e").tolist() == [0.02]
    with pytest.raises(InputError, match="no column 'Rechtswert'; its columns are: Name, EASTING, AccHor"):
        table_of(tmp_path, text, columns={"x": "Rechtswert"}).numbers("x")


def test_empty_cells_and_integers(tmp_path: Path) -> None:
    table = table_of(tmp_path, "a,b\n1,\n2.0,3\n")
    np.testing.assert_array_equal(table.numbers("b", allow_empty=True), [np.nan, 3.0])
    assert table.integers("a").tolist() == [1, 2]


def test_no_rows_where_allowed(tmp_path: Path) -> None:
    table = table_of(tmp_path, "a,b\n", allow_no_rows=True)
    assert len(table) == 0
    assert table.stack(("a", "b")).shape == (0, 2)


@pytest.mark.parametrize(
    ("comment", "expected"),
    [
        ("CRS: EPSG:25832, height: ellipsoidal GRS80, metres.", ("EPSG:25832", "ellipsoidal", None, None)),
        ("crs = epsg 32647+5773", ("EPSG:32647", "EPSG:5773", None, None)),
        ("CRS: EPSG:25832, height: EPSG:7837", ("EPSG:25832", "EPSG:7837", None, None)),
        ("CRS: EPSG:25832, height: DHHN2016", ("EPSG:25832", "DHHN2016", None, None)),
        ("Local engineering CRS of the site, metres.", ("local", None, None, None)),
        ("CRS: local", ("local", None, None, None)),
        ("Angles: degrees, R = Rx(omega) Ry(phi) Rz(kappa), image (right, top, back) to grid (E, N, up).",
         (None, None, "omega-phi-kappa", "deg")),
        ("Angles: omega, phi, kappa in gon", (None, None, "omega-phi-kappa", "gon")),
        ("angles: yaw/pitch/roll, rad", (None, None, "yaw-pitch-roll", "rad")),
        ("R = Ry(phi) Rx(omega) Rz(kappa)", (None, None, "Ry(phi) Rx(omega) Rz(kappa)", None)),
        ("Antenna height: 1.5 m; local time; degrees of freedom 3", (None, None, None, None)),
        ("Covariance: ... World: frame with CRS: EPSG:4979, height: ellipsoidal", (None, None, None, None)),
    ],
)  # fmt: skip
def test_declarations(comment: str, expected: tuple[str | None, ...]) -> None:
    declared = parse_declarations([(3, comment)], Path("a.csv"))
    assert (declared.crs, declared.height, declared.angles, declared.angle_unit) == expected
    assert set(declared.rows.values()) <= {3}


def test_comments_below_the_header_declare_nothing(tmp_path: Path) -> None:
    assert table_of(tmp_path, "a,b\n# CRS: EPSG:25832\n1,2\n").declared_crs is None


def test_checks_pass_what_they_cannot_compare(tmp_path: Path) -> None:
    plain = table_of(tmp_path, "a,b\n1,2\n")
    check_declared_crs(plain, "EPSG:25832")
    check_declared_height(plain, "ellipsoidal")
    check_declared_angles(plain, "yaw-pitch-roll", "gon")
    table = table_of(tmp_path, "# CRS: EPSG:25832, height: DHHN2016\na,b\n1,2\n")
    check_declared_crs(table, "ETRS89 / UTM zone 32N")
    check_declared_crs(table, " EPSG:25832+7837")
    check_declared_height(table, "EPSG:7837")
    with pytest.raises(InputError, match="'DHHN2016', the project has 'ellipsoidal'"):
        check_declared_height(table, "ellipsoidal")
    with pytest.raises(InputError, match="declares the CRS EPSG:25832, the project has local"):
        check_declared_crs(table, "local")
    check_declared_crs(table_of(tmp_path, "# Local engineering CRS\na,b\n1,2\n"), "local")


def test_half_a_million_numbers_in_seconds(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    lines = [f"P{i};b{i % 300}.jpg;{x:.3f};{y:.3f};0,5" for i, (x, y) in enumerate(rng.random((170_000, 2)) * 4000)]
    text = "point;image;x;y;sigma_px\n" + "\n".join(lines).replace(".", ",").replace(",jpg", ".jpg")
    start = time.process_time()
    values = table_of(tmp_path, text).stack(("x", "y", "sigma_px"))
    assert values.shape == (170_000, 3)
    assert time.process_time() - start < 5.0
