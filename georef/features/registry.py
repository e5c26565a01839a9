"""The tables of interchangeable components, and the one function that makes a component from its name."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from georef.errors import ConfigError


class ComponentTable(dict[str, str]):
    """Names of components and where they are made ("module:callable"), also open to entry points of installed packages.

    Nothing is imported until a component is loaded.
    """

    def __init__(self, kind: str, group: str, entries: Mapping[str, str]) -> None:
        super().__init__(entries)
        self.kind = kind  # how messages call it
        self.group = group  # of the entry points

    def names(self) -> list[str]:
        """All known names, sorted: those of this table and those of entry points."""
        return sorted({*self, *(point.name for point in entry_points(group=self.group))})

    def resolve(self, name: str) -> EntryPoint:
        """Where a name's component is made. Raises ConfigError for an unknown name; this table goes before others."""
        if name in self:
            return EntryPoint(name, self[name], self.group)
        for point in entry_points(group=self.group):
            if point.name == name:
                return point
        raise ConfigError(self._unknown(name))

    def _unknown(self, name: str) -> str:
        close = difflib.get_close_matches(name.lower(), self.names(), n=1, cutoff=0.4)
        hint = f"\nDid you mean '{close[0]}'?" if close else ""
        return f"There is no {self.kind} '{name}'.\nExpected one of: {', '.join(self.names())}.{hint}"


EXTRACTORS = ComponentTable(
    "extractor",
    "georef.extractors",
    {
        "sift": "georef.features.sift:Sift",
        "aliked-n16": "georef.features.aliked:AlikedN16",
        "aliked-n16rot": "georef.features.aliked:AlikedN16Rot",
        "aliked-n32": "georef.features.aliked:AlikedN32",
        "disk": "georef.features.disk:Disk",
        "xfeat": "georef.features.xfeat:XFeat",
        "superpoint": "georef.features.superpoint:SuperPoint",
        "rdd": "georef.features.rdd:Rdd",
    },
)

MATCHERS = ComponentTable(
    "matcher",
    "georef.matchers",
    {
        "mutual-nn": "georef.features.nearest:MutualNearest",
        "lightglue-aliked": "georef.features.lightglue:LightGlueAliked",
        "lightglue-disk": "georef.features.lightglue:LightGlueDisk",
        "lighterglue-xfeat": "georef.features.lightglue:LighterGlue",
        "lightglue-sift": "georef.features.lightglue:LightGlueSift",
        "lightglue-superpoint": "georef.features.lightglue:LightGlueSuperPoint",
        "lightglue-rdd": "georef.features.lightglue:LightGlueRdd",
    },
)


GLOBAL_DESCRIPTORS = ComponentTable(
    "global descriptor",
    "georef.global_descriptors",
    {
        "vlad": "georef.features.globals.vlad:Vlad",
        "efficientnet-gem": "georef.features.globals.efficientnet:EfficientNetGem",
        "megaloc": "georef.features.globals.salad:megaloc",
        "dinov2-salad": "georef.features.globals.salad:dinov2_salad",
        "anyloc": "georef.features.globals.anyloc:anyloc",
        "eigenplaces-512": "georef.features.globals.cosplace:eigenplaces_512",
        "eigenplaces-2048": "georef.features.globals.cosplace:eigenplaces_2048",
        "cosplace-512": "georef.features.globals.cosplace:cosplace_512",
        "cosplace-2048": "georef.features.globals.cosplace:cosplace_2048",
        "netvlad": "georef.features.globals.netvlad:netvlad",
    },
)


def load_component(table: ComponentTable, name: str, *, device: Any = None, **options: Any) -> Any:
    """Make the component of that name: `load_component(EXTRACTORS, "sift")`; options go to its constructor.

    device: "cpu", "cuda" or "auto", for components that have a choice; the others do without.

    Raises ConfigError for an unknown name or option, or a component whose module cannot be imported; what the
    constructor raises (WeightsError, for one) passes through.
    """
    point = table.resolve(name)
    try:
        make = getattr(import_module(point.module), point.attr)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"The {table.kind} '{name}' cannot be loaded from {point.value}: {error}") from error
    if device is not None and "device" in inspect.signature(make).parameters:
        options["device"] = device
    try:
        inspect.signature(make).bind(**options)
    except TypeError as error:
        known = ", ".join(inspect.signature(make).parameters) or "none"
        raise ConfigError(
            f"The {table.kind} '{name}' cannot be made with these options: {error}.\nExpected options: {known}."
        ) from error
    return make(**options)
