"""Builds the triangles of one piece of the street in one epoch."""

from __future__ import annotations

from collections.abc import Sequence

from georef.simulate import furniture, roads, vegetation
from georef.simulate.buildings import house
from georef.simulate.mesh import Builder, Mesh
from georef.simulate.street import Epoch, Item, Street
from georef.simulate.vehicles import car


def build_chunk(street: Street, items: Sequence[Item], epoch: Epoch) -> Mesh:
    """The mesh of the objects that are there in the epoch."""
    b = Builder()
    autumn = epoch == "second" and street.amount("season") > 0
    for item in items:
        version = item.version(epoch)
        if version is not None:
            b.start(item.world_from_item, item.number)
            _build(b, street, item, version, autumn)
    return b.finish()


def _build(b: Builder, street: Street, item: Item, version: int, autumn: bool) -> None:
    seed, values = item.seed + 7919 * (version - 1), item.values
    if item.kind == "house":
        house(b, values[0], values[1], seed)
    elif item.kind == "car":
        car(b, values[0] if version == 1 else (values[0] * 7.3) % 1.0, seed)
    elif item.kind == "tree":
        vegetation.tree(b, values[0], seed if version == 2 else item.seed, autumn)
    elif item.kind == "hedge":
        vegetation.hedge(b, values[0], seed if version == 2 else item.seed, autumn)
    elif item.kind == "fence":
        furniture.fence(b, values[0], seed)
    elif item.kind == "marking":
        roads.marking(b, int(values[0]), values[1], values[2], item.seed, version)
    elif item.kind == "road":
        roads.road(b, street.axis, values[0], values[1], item.seed)
    elif item.kind == "ground":
        roads.ground_tile(b, values[0], values[1], values[2])
    elif item.kind == "corner":
        roads.corner(b, street.axis, values[0], values[1])
    else:
        furniture.MAKERS[item.kind](b, seed)
