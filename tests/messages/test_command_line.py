"""The command line itself: its help, usage errors, exit codes, and the verbs beside `run`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from georef import __version__
from georef.cli import app
from georef.features import weights
from georef.project import open_project
from georef.stages.survey import load_survey
from georef.terminal import exit_code
from tests.worlds.tiny import EPOCH

SNAPSHOTS = Path(__file__).parent / "snapshots"
UPDATE = "GEOREF_UPDATE_SNAPSHOTS"  # set it to write the snapshots anew
VERBS = [
    "",
    "init",
    "doctor",
    "run",
    "adjust",
    "demo",
    "status",
    "report",
    "view",
    "evaluate",
    "weights",
    "weights list",
    "weights fetch",
    "benchmark",
    "benchmark vectors",
    "benchmark features",
    "benchmark extraction",
    "benchmark adjustment",
]
GEOREF = [sys.executable, "-c", "from georef.cli import main; main()"]
POSES = "# CRS: EPSG:25832, height: ellipsoidal, metres.\nimage,easting,northing,height,omega,phi,kappa\n"


def called(*arguments: str | Path) -> int:
    return exit_code(app, [str(argument) for argument in arguments])


@pytest.mark.parametrize("verb", VERBS)
def test_help(verb: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"}.items():
        monkeypatch.setenv(name, value)
    assert called(*verb.split(), "--help") == 0
    text = "\n".join(line.rstrip() for line in capsys.readouterr().out.splitlines()) + "\n"
    stored = SNAPSHOTS / f"help {verb}".strip().replace(" ", "_")
    stored = stored.with_suffix(".txt")
    if os.environ.get(UPDATE):
        stored.write_text(text, encoding="utf-8")
    assert text == stored.read_text(encoding="utf-8"), f"if this is meant, run with {UPDATE}=1 and look at the change"


def test_every_verb_has_a_snapshot() -> None:
    names = {name for name in app if not name.startswith("-")}
    missing = [name for name in names if not (SNAPSHOTS / f"help_{name}.txt").is_file()]
    assert missing == []


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert called("--version") == 0
    assert capsys.readouterr().out.strip() == __version__


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["run", "x", "--wrong"], "Unknown option: --wrong.\nUsage: georef run ..., see georef run --help\n"),
        (["runn"], 'Unknown command "runn". Did you mean "run"?'),
        (["run"], "requires an argument"),
        (["init", "x"], "--data"),
        (["init", "x", "--data", "y", "--angles", "opk"], 'Choose from: "omega-phi-kappa", "yaw-pitch-roll"'),
        (["weights", "fetsh"], "fetch"),
    ],
)
def test_wrong_usage_is_exit_code_2(arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert called(*arguments) == 2
    captured = capsys.readouterr()
    assert text in captured.err
    assert "--help" in captured.err
    assert captured.out == ""


def test_an_unexpected_fault_is_not_hidden(monkeypatch: pytest.MonkeyPatch, tiny_tables: Path) -> None:
    monkeypatch.setattr("georef.pipeline.status", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        called("status", tiny_tables)


def test_a_folder_that_may_not_be_written_is_no_traceback(
    tiny_tables: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tiny_tables / "file").touch()
    assert called("run", tiny_tables, "-o", tiny_tables / "file" / "out") == 1
    assert "Not a directory" in capsys.readouterr().err


def test_status_of_a_new_project(tiny_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert called("status", tiny_tables) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"project tiny, epoch {EPOCH}, results in ")
    assert [line.split() for line in lines[4:]] == [
        [name, "new"] for name in ("features", "network", "index", "localize", "adjust", "report")
    ]


def test_a_reader_that_goes_away_is_no_fault(tiny_tables: Path) -> None:
    process = subprocess.Popen(
        [*GEOREF, "status", str(tiny_tables)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == ""
    assert process.wait(timeout=120) == 141
    process.stderr.close()


def test_an_interrupted_run_says_how_to_go_on(tiny_tables: Path) -> None:
    code = (  # a shell ignores the interrupt on behalf of what it starts in the background, and children inherit that
        "import signal, time, georef.project as p; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "p.open_project = lambda *a, **k: print('here', flush=True) or time.sleep(60)"
    )
    command = [sys.executable, "-c", f"{code}\nfrom georef.cli import main; main()", "status", str(tiny_tables)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, complaint = process.communicate(timeout=60)
    assert (process.returncode, complaint) == (130, "Interrupted; run the same command again to go on.\n")


def test_weights_that_are_missing_or_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("GEOREF_CACHE", str(tmp_path))
    assert called("weights", "verify") == 1
    assert weights.FETCH_COMMAND in capsys.readouterr().out
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "aliked-n16.pth").write_bytes(b"changed")
    assert called("weights", "list") == 0
    states = dict(line.split()[:2] for line in capsys.readouterr().out.splitlines())
    assert (states["aliked-n16"], states["aliked-n32"]) == ("wrong", "missing")
    assert called("weights", "fetch", "aliked-n17") == 1
    assert "There are no weights 'aliked-n17'." in capsys.readouterr().err


def test_report_of_an_epoch_that_was_not_run(tiny_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert called("report", tiny_tables) == 1
    assert "This epoch has no report yet.\nRun the project first" in capsys.readouterr().err


def test_doctor_of_a_project(tiny_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert called("doctor", tiny_tables) == 0
    text = capsys.readouterr().out
    assert "ETRS89 / UTM zone 32N), ellipsoidal height; grid scale 0.9996" in text
    assert "reference: 8 images over" in text
    assert f"epoch {EPOCH}: 3 images, 3 with GNSS" in text
    assert f"epoch {EPOCH}: 3 control and" in text
    assert {line.split()[0] for line in text.splitlines() if line[0] != " "} <= {"ok", "warning"}


def test_doctor_finds_what_is_wrong(tiny_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tiny_tables / f"{EPOCH}_gnss.csv"
    path.write_text(path.read_text(encoding="utf-8").replace("4565", "4567"), encoding="utf-8")
    assert called("doctor", tiny_tables) == 0
    assert "Most are far from the reference" in capsys.readouterr().out
    (tiny_tables / "camera.csv").unlink()
    assert called("doctor", tiny_tables) == 1
    text = capsys.readouterr().out
    assert "fail     The file does not exist." in text
    assert "camera.csv" in text


def init(tables: Path, *options: str | Path) -> int:
    (tables / "project.toml").unlink(missing_ok=True)
    return called("init", tables / "made", "--data", tables, *options)


def test_init_writes_a_project_that_opens(tiny_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    by_hand = load_survey(open_project(tiny_tables), EPOCH)
    assert init(tiny_tables, "--check-kind", "absolute") == 0
    said = capsys.readouterr().out
    for text in ("crs: EPSG:25832 (stated in reference_eo.csv)", "height: ellipsoidal", "angles: omega-phi-kappa"):
        assert text in said
    project = open_project(tiny_tables / "made", data=tiny_tables)
    assert project.file.crs.origin is not None
    assert project.file.name == "tables"
    made = load_survey(project, EPOCH)
    assert len(made.check) == len(by_hand.check)
    assert [i.image_id for i in made.reference.images] == [i.image_id for i in by_hand.reference.images]
    assert called("status", tiny_tables / "made", "--data", tiny_tables) == 0


def _with_rig(tables: Path, stations: tuple[str, str, str]) -> None:
    """A rig of two cameras; the tiny epoch's three images belong to stations."""
    one, two = ("camera,x,y,z,yaw,pitch,roll,sigma_m,sigma_deg", "cam,0,0,0,0,0,0,0,0")
    (tables / "rig.csv").write_text(f"{one}\n{two}\nother,1,0,0,90,0,0,0.001,0.01\n", encoding="utf-8")
    path = tables / f"{EPOCH}_gnss.csv"
    lines = path.read_text(encoding="utf-8").splitlines()
    head = next(i for i, line in enumerate(lines) if line[0] != "#")
    lines[head] += ",station"
    lines[head + 1 :] = [f"{line},{name}" for line, name in zip(lines[head + 1 :], stations, strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def test_init_and_doctor_know_rigs(tiny_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _with_rig(tiny_tables, ("0", "1", ""))
    assert init(tiny_tables, "--check-kind", "absolute") == 0
    assert f"epoch {EPOCH}: a rig, rig.csv" in capsys.readouterr().out
    assert called("doctor", tiny_tables / "made", "--data", tiny_tables) == 0
    text = capsys.readouterr().out
    assert f"epoch {EPOCH}: 2 exposures of a rig (2 of 1 images)" in text
    assert "No exposure has two images" in text


def test_init_leaves_out_a_rig_without_stations(tiny_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tiny_tables / "rig.csv").write_text("camera\n", encoding="utf-8")
    assert init(tiny_tables, "--check-kind", "absolute") == 0
    assert "rig.csv is left out, its positions have no column 'station'" in capsys.readouterr().out
    assert "rig =" not in (tiny_tables / "made" / "project.toml").read_text(encoding="utf-8")


def test_init_overwrites_nothing(tiny_tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (tiny_tables / "project.toml").read_bytes()
    assert called("init", tiny_tables, "--data", tiny_tables, "--check-kind", "absolute") == 1
    assert "There is a project already" in capsys.readouterr().err
    assert (tiny_tables / "project.toml").read_bytes() == before


@pytest.mark.parametrize(
    ("old", "new", "options", "text"),
    [
        ("", "", [], "--check-kind absolute or --check-kind relative"),
        ("# CRS: EPSG:25832, height: ellipsoidal, metres.", "#", [], "--crs EPSG:25832, or --crs local"),
        (", height: ellipsoidal", "", [], "--height ellipsoidal or --height EPSG:code"),
        ("Angles: degrees, R = Rx(omega) Ry(phi) Rz(kappa)", "Angles: degrees", [], "--angles omega-phi-kappa or"),
        ("Angles: degrees", "Angles: see below", [], "--angle-unit deg, gon or rad"),
        ("easting,northing", "X,Y", [], "--column easting=... --column northing=..."),
        ("", "", ["--crs", "EPSG:25833"], "declares crs = 'EPSG:25832', --crs says 'EPSG:25833'"),
        ("", "", ["--height", "EPSG:7837"], "declares height = 'ellipsoidal', --height says 'EPSG:7837'"),
        ("", "", ["--angles", "yaw-pitch-roll"], "declares angles = 'omega-phi-kappa', --angles says"),
        ("", "", ["--column", "easting"], "--column 'easting' cannot be read."),
    ],
)
def test_init_asks_for_what_nobody_says(
    tiny_tables: Path, old: str, new: str, options: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in tiny_tables.glob("*.csv"):
        path.write_text(path.read_text(encoding="utf-8").replace(old, new) if old else path.read_text(encoding="utf-8"))
    assert init(tiny_tables, *options) == 1
    assert text in capsys.readouterr().err
    assert not (tiny_tables / "made").exists()


def test_init_takes_what_is_stated(tiny_tables: Path) -> None:
    for path in tiny_tables.glob("*.csv"):
        text = path.read_text(encoding="utf-8").replace("easting,northing", "R,H")
        path.write_text("\n".join(line for line in text.splitlines() if line[0] != "#") + "\n", encoding="utf-8")
    stated = "--crs EPSG:25832 --height ellipsoidal --angles omega-phi-kappa --angle-unit deg --check-kind absolute"
    assert init(tiny_tables, *stated.split(), "--column", "easting=R", "--column", "northing=H", "--name", "here") == 0
    project = open_project(tiny_tables / "made", data=tiny_tables)
    assert project.file.name == "here"
    assert len(load_survey(project, EPOCH).reference.images) == 8


@pytest.mark.parametrize("name", ["reference_eo.csv", "camera.csv", f"{EPOCH}_gnss.csv"])
def test_init_says_which_file_it_misses(tiny_tables: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    (tiny_tables / name).unlink()
    assert init(tiny_tables, "--check-kind", "absolute") == 1
    assert name.replace(EPOCH, "<epoch>") in capsys.readouterr().err


def test_evaluate_counts_failed_images_as_infinitely_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [f"n{i}.jpg,45658{i}.0,5421025.0,170.0,80,10,0" for i in range(4)]
    truth, poses = tmp_path / "truth.csv", tmp_path / "poses.csv"
    truth.write_text(POSES + "\n".join(rows) + "\n", encoding="utf-8")
    moved = rows[0].replace("170.0", "170.03")
    poses.write_text(POSES + f"{moved}\n{rows[1]}\nextra.jpg,456580,5421025,170,0,0,0\n", encoding="utf-8")
    assert called("evaluate", "--poses", poses, "--truth", truth, "--truth-sigma", "0.01,0.02") == 0
    text = capsys.readouterr().out
    assert "images      2 of 4 have a pose; without: n2.jpg, n3.jpg" in text
    assert "left out, without truth: extra.jpg" in text
    assert "median infinite" in text
    assert "within      0.025 m and  0.25 deg:  25.0 %" in text
    assert "within      0.050 m and  0.50 deg:  50.0 %" in text
    stored = json.loads((tmp_path / "evaluation-poses.json").read_text(encoding="utf-8"))
    assert stored["failed"] == ["n2.jpg", "n3.jpg"]
    assert stored["position_m"]["median"] is None
    assert stored["images"][0]["dh_m"] == pytest.approx(0.03, abs=1e-5)
    assert stored["crs"] == {"horizontal": "EPSG:25832", "height": "ellipsoidal"}


@pytest.mark.parametrize(
    ("poses", "options", "text"),
    [
        (POSES.split("\n", 1)[1], [], "--crs EPSG:25832 --height ellipsoidal, or --crs local"),
        (POSES.replace("25832", "25833"), [], "says 'EPSG:25833'"),
        (POSES, ["--crs", "EPSG:25833"], "--crs says 'EPSG:25833'"),
        (POSES, ["--truth-sigma", "1cm"], "Expected POSITION_M,ROTATION_DEG"),
        (POSES, ["--truth-sigma=-1,0"], "neither of them negative"),
        (POSES.replace("image,", "picture,"), [], "no column 'image'"),
        (POSES + "other.jpg,456580.0,5421025.0,170.0,80,10,0\n", [], "No image of poses.csv has a true pose"),
    ],
)
def test_evaluate_explains_what_it_misses(
    tmp_path: Path, poses: str, options: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    declared = POSES if "# CRS" in poses else POSES.split("\n", 1)[1]
    row = "n0.jpg,456580.0,5421025.0,170.0,80,10,0\n"
    (tmp_path / "truth.csv").write_text(declared + row, encoding="utf-8")
    (tmp_path / "poses.csv").write_text(poses + ("" if "other" in poses else row), encoding="utf-8")
    assert called("evaluate", "--poses", tmp_path / "poses.csv", "--truth", tmp_path / "truth.csv", *options) == 1
    assert text in capsys.readouterr().err
    assert not (tmp_path / "evaluation-poses.json").exists()
