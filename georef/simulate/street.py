"""The plan of the street: what stands where in each epoch. Cheap and deterministic; nothing is built here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from georef.errors import ConfigError
from georef.geometry.rigid import Array, Rigid3
from georef.simulate.axis import Axis, loop_axis, straight_axis

Epoch = Literal["first", "second"]
ChangeKind = Literal["light", "season", "cars", "vegetation", "facade", "fences", "markings"]

SHORTEST_M, SHORTEST_LOOP_M, CORNER_RADIUS_M = 20.0, 200.0, 16.0
CHUNK_M = 30.0


@dataclass(frozen=True)
class StreetOptions:
    """change scales every difference between the epochs (0: none, 1: strong); switched_on kinds are strong anyway."""

    seed: int = 0
    length_m: float = 60.0
    layout: Literal["straight", "loop"] = "straight"
    change: float = 1.0
    switched_on: tuple[ChangeKind, ...] = ()

    def amount(self, kind: ChangeKind) -> float:
        return 1.0 if kind in self.switched_on else self.change


@dataclass(frozen=True, eq=False)
class Item:
    """One object: where it stands, the box that holds it (low, high, in its frame), and its version in each epoch.

    A version is a seed of its looks, None where the object is absent; values are the kind's own.
    """

    number: int
    kind: str
    along_m: float
    seed: int
    world_from_item: Rigid3
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    versions: tuple[int | None, int | None]
    values: tuple[float, ...] = ()

    @property
    def chunk(self) -> int:
        return int(np.floor(self.along_m / CHUNK_M))

    def version(self, epoch: Epoch) -> int | None:
        return self.versions[0 if epoch == "first" else 1]

    def box_in_world(self) -> tuple[Array, Array]:
        """Lowest and highest corner (3,) of the axis-parallel box around the object."""
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=bool)
        points = self.world_from_item.apply(np.where(corners, self.high, self.low))
        return points.min(axis=0), points.max(axis=0)


@dataclass(frozen=True, eq=False)
class Change:
    """What differs between the epochs: kind, the box (3,) (3,) in world that holds it in both, and a few words."""

    kind: ChangeKind
    low_in_world: Array
    high_in_world: Array
    what: str
    item_number: int


@dataclass(frozen=True, eq=False)
class Street:
    """The plan: axis, objects, and what differs between the epochs."""

    options: StreetOptions
    axis: Axis
    items: tuple[Item, ...]
    changes: tuple[Change, ...]
    chunks: dict[int, tuple[Item, ...]] = field(repr=False)

    def amount(self, kind: ChangeKind) -> float:
        return self.options.amount(kind)


def build_street(options: StreetOptions) -> Street:
    """The plan of a street; the same options give the same street on every machine."""
    from georef.simulate.layout import plan

    _check(options)
    closed = options.layout == "loop"
    axis = loop_axis(options.length_m, CORNER_RADIUS_M) if closed else straight_axis(options.length_m)
    items = plan(options, axis)
    chunks: dict[int, list[Item]] = {}
    for item in items:
        chunks.setdefault(item.chunk, []).append(item)
    changes = tuple(_change(item) for item in items if item.versions[0] != item.versions[1])
    return Street(options, axis, items, changes, {key: tuple(chunks[key]) for key in sorted(chunks)})


_KIND_OF_CHANGE: dict[str, ChangeKind] = {
    "house": "facade",
    "car": "cars",
    "tree": "vegetation",
    "hedge": "vegetation",
    "fence": "fences",
    "marking": "markings",
}


def _change(item: Item) -> Change:
    first, second = item.versions
    verb = "appeared" if first is None else "gone" if second is None else "changed"
    low, high = item.box_in_world()
    return Change(_KIND_OF_CHANGE[item.kind], low, high, f"{item.kind} {verb}", item.number)


def _check(options: StreetOptions) -> None:
    shortest = SHORTEST_LOOP_M if options.layout == "loop" else SHORTEST_M
    if not options.length_m >= shortest:
        raise ConfigError(
            f"A street of layout '{options.layout}' cannot be {options.length_m:g} m long.",
            f"Expected length_m of at least {shortest:g}.",
        )
    if not 0.0 <= options.change <= 1.0:
        raise ConfigError(
            f"change = {options.change:g} is not a share.", "Expected 0 (no change) to 1 (strong change)."
        )
