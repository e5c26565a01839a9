"""The rules of the house that a machine can check, by reading the source."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "georef"
SOURCES = sorted(PACKAGE.rglob("*.py"))

# Room -> the rooms that it may import: a room reaches down this list, never up or sideways unless it is said here.
ALLOWED: dict[str, set[str]] = {
    "errors": set(),
    "cache": set(),
    "replacing": set(),
    "pictures": set(),
    "geometry": set(),
    "types": {"geometry"},
    "crs": {"errors", "geometry"},
    "config": {"errors"},
    "sections": {"config"},
    "epoch_sections": {"config", "sections"},
    "project": {"errors", "config", "sections", "epoch_sections"},
    "executor": {"errors"},
    "progress": set(),
    "io": {"errors", "replacing", "pictures", "geometry", "types", "crs"},
    "features": {"errors", "cache", "replacing", "pictures", "geometry", "types"},
    "store": {"errors", "replacing", "geometry", "types"},
    "evaluation": {"errors", "geometry", "types"},
    # takes frozen sections of the configuration, and a Progress to show; opens no file
    "estimation": {"errors", "config", "executor", "geometry", "types", "features", "evaluation"},
    "capture": {"errors", "config", "geometry", "types", "crs", "io"},
    "simulate": {"errors", "replacing", "geometry", "types", "crs", "io", "project", "estimation"},
    "report": {"errors", "geometry", "types", "crs", "evaluation"},
    "viewer": {"errors", "config", "replacing", "pictures", "geometry", "types", "features", "report"},
    "stages": {
        *("errors", "cache", "config", "project", "executor", "geometry", "types", "crs", "io", "features", "store"),
        *("evaluation", "estimation", "capture", "simulate", "report", "viewer", "sections"),
        "epoch_sections",
    },
    # measures what lies below the pipeline
    "benchmarks": {
        *("errors", "cache", "config", "project", "executor", "geometry", "types", "crs", "io", "features", "store"),
        *("evaluation", "estimation", "capture", "simulate", "report", "viewer", "stages"),
    },
    "pipeline": {"errors", "config", "project", "executor", "types", "io", "stages"},
    "comparison": {
        *("errors", "config", "project", "executor", "geometry", "types", "crs", "io", "store", "evaluation", "report"),
        *("stages", "pipeline"),
    },
    "doctor": {"errors", "config", "project", "features", "stages"},
    "terminal": {"errors"},
    "cli_weights": {"errors", "terminal", "doctor", "features"},
    "cli_benchmark": {"errors", "terminal", "io", "benchmarks"},
    "cli_options": {"executor", "progress", "project"},
    "cli_adjust": {"cli_options", "terminal", "project", "stages", "pipeline"},
    "cli_evaluate": {"cli_options", "comparison", "stages", "terminal"},
    "cli": {
        *("errors", "terminal", "cli_options", "cli_weights", "cli_benchmark", "cli_evaluate", "doctor", "project"),
        *("pipeline", "stages", "viewer", "capture", "simulate", "cli_adjust"),
    },
}
FOLDER_NAMES = {"work", "epochs", "campaigns"}  # inside a project
SPEAKING = {"terminal", "progress", "cli", "cli_options"}  # what may write to a standard stream
GROWN_LINES = 300


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def imported_rooms(path: Path) -> Iterator[tuple[int, str]]:
    """Line and room of each import of the package, wherever it stands in the file."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: a relative import"
            base = node.module or ""
            names = [f"{base}.{alias.name}" for alias in node.names] if base == "georef" else [base]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        for name in names:
            parts = name.split(".")
            if parts[0] == "georef" and len(parts) > 1 and not parts[1].startswith("__"):
                yield node.lineno, parts[1]


def strings(path: Path) -> Iterator[tuple[int, str]]:
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def calls(path: Path) -> Iterator[tuple[ast.Call, str]]:
    """Each call with the last part of the name that is called."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Call):
            function = node.func
            name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
            yield node, name


def place(path: Path, line: int, what: str = "") -> str:
    return f"{path.relative_to(PACKAGE.parent)}:{line} {what}".rstrip()


def test_every_room_is_in_the_table() -> None:
    assert {room(path) for path in SOURCES} - {"__init__", "__main__"} <= set(ALLOWED)


def test_the_table_has_no_circles() -> None:
    done: set[str] = set()
    while len(done) < len(ALLOWED):
        ready = {name for name, below in ALLOWED.items() if name not in done and below <= done}
        assert ready, f"rooms that import each other: {sorted(set(ALLOWED) - done)}"
        done |= ready


def test_imports_point_downwards() -> None:
    wrong = [
        place(path, line, f"{room(path)} imports {other}")
        for path in SOURCES
        for line, other in imported_rooms(path)
        if other != room(path) and other not in ALLOWED[room(path)]
    ]
    assert wrong == []


def test_library_code_does_not_print() -> None:
    wrong = [
        place(path, node.lineno) for path in SOURCES for node, name in calls(path) if name == "print" and _bare(node)
    ]
    assert wrong == []
    wrong = [place(path, line) for path in SOURCES if room(path) not in SPEAKING for line in _stream_lines(path)]
    assert wrong == []


def _bare(call: ast.Call) -> bool:
    return isinstance(call.func, ast.Name)


def _stream_lines(path: Path) -> list[int]:
    """Lines that name sys.stdout or sys.stderr."""
    attributes = [node for node in ast.walk(tree(path)) if isinstance(node, ast.Attribute)]
    return [node.lineno for node in attributes if ast.unparse(node) in ("sys.stdout", "sys.stderr")]


def test_nothing_that_is_read_can_run_code() -> None:
    modules = {"pickle", "cPickle", "dill", "joblib", "shelve", "marshal"}
    for path in SOURCES:
        for node in ast.walk(tree(path)):
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                named = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
                assert not modules & {name.split(".")[0] for name in named}, place(path, node.lineno)
        assert [place(path, node.lineno, why) for node, name in calls(path) if (why := _unsafe(node, name))] == []


def _unsafe(call: ast.Call, name: str) -> str:
    given = {k.arg: k.value.value for k in call.keywords if isinstance(k.value, ast.Constant)}
    if given.get("allow_pickle") is True or given.get("weights_only") is False or given.get("shell") is True:
        return "allows what it should not"
    if ast.unparse(call.func) == "torch.load" and given.get("weights_only") is not True:
        return "torch.load without weights_only=True"
    return name if _bare(call) and name in ("eval", "exec") else ""


def test_only_project_knows_folder_names() -> None:
    for path in SOURCES:
        if room(path) == "project":
            continue
        divisions = [n for n in ast.walk(tree(path)) if isinstance(n, ast.BinOp) and isinstance(n.op, ast.Div)]
        parts = [(n.lineno, c.value) for n in divisions for c in ast.walk(n.right) if isinstance(c, ast.Constant)]
        assert [place(path, line, str(name)) for line, name in parts if name in FOLDER_NAMES] == []


def test_no_machine_is_named() -> None:
    roots = ("/" + "home/", "/" + "root/", "/" + "Users/", "C:" + "\\")
    wrong = [place(path, line) for path in SOURCES for line, text in strings(path) if any(r in text for r in roots)]
    assert wrong == []


def test_files_stay_small() -> None:
    lengths = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in SOURCES}
    assert {name: length for name, length in lengths.items() if length > GROWN_LINES} == {}


def test_pure_rooms_open_no_files() -> None:
    readers = {
        "open",
        "read_text",
        "write_text",
        "read_bytes",
        "write_bytes",
        "imread",
        "imwrite",
        "loadtxt",
        "savetxt",
    }
    pure = [path for path in SOURCES if room(path) in ("geometry", "types", "evaluation", "estimation")]
    assert [place(path, node.lineno) for path in pure for node, name in calls(path) if name in readers] == []


def test_the_command_line_starts_light() -> None:
    """Nothing heavy is imported before a verb asks for it."""
    heavy = {
        "torch",
        "numpy",
        "scipy",
        "cv2",
        "gtsam",
        "pycolmap",
        "pyproj",
        "kornia",
        "rerun",
        "matplotlib",
        "pydantic",
        "lancedb",
        "pyarrow",
    }
    code = "import sys, georef.cli; print(' '.join({name.split('.')[0] for name in sys.modules}))"
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert heavy & set(finished.stdout.split()) == set()


def test_the_simulated_truth_is_out_of_the_pipeline_s_reach() -> None:
    """Only the verb `demo` and the benchmark of the adjustment know the simulation; the stages that the verb runs are
    those of any project."""
    outside = [path for path in SOURCES if room(path) != "simulate"]
    importers = [path for path in outside if "simulate" in {name for _, name in imported_rooms(path)}]
    assert importers == [PACKAGE / "benchmarks" / "adjustment_problem.py", PACKAGE / "stages" / "demo.py"]
