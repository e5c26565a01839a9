"""Files: text read in whatever encoding it has, anything written as a whole or not at all."""

from __future__ import annotations

import codecs
import difflib
import logging
import shutil
from collections.abc import Iterable
from pathlib import Path

from georef.errors import InputError
from georef.replacing import replacing

log = logging.getLogger(__name__)

_BYTE_ORDER_MARKS = (  # UTF-32 first: its mark begins with that of UTF-16
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_FALLBACKS = ("cp1252", "latin-1")  # the second accepts every byte


def read_text(path: Path, encoding: str | None = None) -> str:
    """The text of a file: by its byte order mark, else UTF-8, else Windows-1252 (logged). Line ends become '\\n'.

    Raises InputError for a file that is missing, a directory, unreadable, or not text.
    """
    data = _read_bytes(path)
    try:
        text = data.decode(encoding).removeprefix("\ufeff") if encoding else _decode(data, path)
    except (LookupError, UnicodeError) as error:
        raise InputError(
            f"The file cannot be decoded: {error}.",
            expected="text in UTF-8, UTF-16 with a byte order mark, or Windows-1252.",
            remedy='Save it as UTF-8, or state its encoding in project.toml: table = { encoding = "..." }.',
            path=path,
        ) from error
    if "\0" in text:
        raise InputError(
            "The file is not text: it holds zero bytes, as spreadsheets and images do.",
            expected="a delimited text table with a header row.",
            remedy="Export the table as CSV (UTF-8).",
            path=path,
        )
    return text.replace("\r\n", "\n").replace("\r", "\n")


def write_text_atomically(text: str, path: Path | str) -> None:
    """Write UTF-8 text with '\\n' line ends as a whole, as `write_bytes_atomically` does."""
    write_bytes_atomically(text.encode("utf-8"), path)


def write_bytes_atomically(data: bytes, path: Path | str) -> None:
    """Write to a temporary file beside `path`, then put it in place.

    Folders are created. An existing file stays as it is until the new one is complete. Raises OSError.
    """
    with replacing(Path(path)) as temporary:
        temporary.write_bytes(data)


def write_lines_atomically(lines: Iterable[str], path: Path | str) -> None:
    """Write lines as they come, UTF-8 with '\\n' line ends, as `write_bytes_atomically` does."""
    with replacing(Path(path)) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{line}\n" for line in lines)


def copy_atomically(source: Path, path: Path) -> None:
    """Copy a file as a whole or not at all."""
    with replacing(path) as temporary:
        shutil.copyfile(source, temporary)


def _read_bytes(path: Path) -> bytes:
    if path.is_dir():
        raise InputError(
            "The path is a directory, not a table.",
            expected="a delimited text file.",
            remedy="Name the file inside it in project.toml.",
            path=path,
        )
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        siblings = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
        near = difflib.get_close_matches(path.name, siblings, n=1)
        hint = f"Did you mean {near[0]!r}? " if near else ""
        raise InputError(
            "The file does not exist.",
            remedy=f"{hint}Correct the name in project.toml, or the folder of the data (--data or GEOREF_DATA).",
            path=path,
        ) from error
    except OSError as error:
        raise InputError(
            f"The file cannot be read: {error.strerror or error}.", remedy="Check its permissions.", path=path
        ) from error


def _decode(data: bytes, path: Path) -> str:
    for mark, encoding in _BYTE_ORDER_MARKS:
        if data.startswith(mark):
            return data.decode(encoding)
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        pass
    for encoding in _FALLBACKS:
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        log.warning("%s is not UTF-8; read as %s", path, encoding)
        return text
    raise AssertionError("latin-1 decodes every byte")
