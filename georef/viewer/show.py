"""Opens a recording in the rerun viewer, bound to this machine alone."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from georef.errors import StageError

HOST, PORT = "127.0.0.1", 9876
_RERUN = "from rerun_cli.__main__ import main; raise SystemExit(main())"  # `-m rerun_cli` loses the exit code


def show_recording(path: Path, port: int = PORT) -> None:
    """Runs the viewer until it is closed. Raises StageError: no recording, no display, or the viewer fails."""
    if not path.is_file():
        raise StageError(
            "There is no recording of this epoch.",
            "Run `georef run` first; it writes one unless report.recording = false.",
            f"Expected {path}.",
        )
    if not has_display(os.environ, sys.platform):
        raise StageError(
            "There is no display to open the viewer on.",
            "Copy the recording to a machine that has one and open it there with `rerun recording.rrd`.",
            f"The recording is {path}.",
        )
    code = _run_viewer([sys.executable, "-c", _RERUN], path, port)
    if code != 0:
        raise StageError(
            f"The rerun viewer ended with code {code}; its own messages stand above.",
            "Where this machine's graphics do not suffice, open the recording on another one: `rerun recording.rrd`.",
            f"The recording is {path}.",
        )


def has_display(environment: Mapping[str, str], platform: str) -> bool:
    """Whether windows can be opened; on Linux a display server has to be named."""
    return not platform.startswith("linux") or bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


def _run_viewer(command: list[str], path: Path, port: int) -> int:
    environment = without_analytics(command)
    arguments = [*command, str(path), "--bind", HOST, "--port", str(port)]
    process = subprocess.Popen(arguments, env=environment, start_new_session=True)
    try:
        return process.wait()
    finally:
        _end(process)


def without_analytics(command: list[str]) -> dict[str, str]:
    """The environment of a viewer that sends no usage statistics, which rerun can only be told in its configuration.

    On Linux that is a configuration of its own, elsewhere the user's.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "georef" / "rerun"
    environment = (
        {**os.environ, "XDG_CONFIG_HOME": str(cache)} if sys.platform.startswith("linux") else dict(os.environ)
    )
    told = subprocess.run(
        [*command, "analytics", "disable"], env=environment, capture_output=True, text=True, check=False
    )
    if told.returncode != 0:
        raise StageError(
            f"The rerun viewer does not start: {told.stderr.strip()[-300:]}",
            "Install rerun-sdk again: pip install rerun-sdk.",
        )
    return environment


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ends the viewer with the process that wraps it, if it still runs."""
    if process.poll() is not None:
        return
    if sys.platform == "win32":
        process.terminate()
    else:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
    process.wait(10)
