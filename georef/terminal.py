"""What the command line says, and the exit code of a command line: mistakes of the user become messages."""

from __future__ import annotations

import errno
import os
import re
import sys
from typing import Any

from cyclopts import App, CycloptsError

from georef.errors import GeorefError

_REFUSED_BY_THE_SYSTEM = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.ENOTDIR)

_WIDTH_IN_A_FILE = 180
_TEXT_COLUMNS = ("name", "step", "what")


def say(*lines: str) -> None:
    """Lines to the standard output, at once."""
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()


def say_table(table: dict[str, Any]) -> None:
    """A table (headings, and rows of cells as pairs of value and interval), the interval below its value."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    console = Console(file=sys.stdout, highlight=False, width=None if sys.stdout.isatty() else _WIDTH_IN_A_FILE)
    shown = Table(title=table["title"], box=SIMPLE_HEAD, title_justify="left", title_style="bold", pad_edge=False)
    for column in table["columns"]:
        left = not column["unit"] and column["key"] in _TEXT_COLUMNS
        heading = re.sub(r"(?<=[,:]) | (?=\()|(?<=median) ", "\n", column["heading"])
        shown.add_column(heading, justify="left" if left else "right", overflow="fold")
    for row in table["shown"]:
        shown.add_row(*(f"{value}\n{interval}" if interval else value for value, interval in row))
    console.print(shown, markup=False)
    for note in table["notes"]:
        console.print(note, markup=False)


def exit_code(app: App, arguments: list[str]) -> int:
    """Runs a command line: 0 done, 1 our error (message only), 2 usage, else what the verb says."""
    try:
        code = app(arguments, result_action="return_value", exit_on_error=False, print_error=False)
    except GeorefError as error:
        return _complain(f"{type(error).__name__}: {error}", 1)
    except CycloptsError as error:
        verb = " ".join(("georef", *(error.command_chain or ())))
        return _complain(f"{error}\nUsage: {verb} ..., see {verb} --help", 2)
    except KeyboardInterrupt:
        return _complain("Interrupted; run the same command again to go on.", 130)
    except BrokenPipeError:  # the reader of our output has gone: nothing can be said any more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        if error.errno not in _REFUSED_BY_THE_SYSTEM:
            raise
        return _complain(f"{error.strerror}: {error.filename or 'while writing results'}", 1)
    return code if isinstance(code, int) else 0


def _complain(text: str, code: int) -> int:
    sys.stderr.write(text + "\n")
    return code
