"""Cofactors, tests and variance components of a block at a state."""

from __future__ import annotations

from dataclasses import dataclass

from georef.errors import GeorefError
from georef.estimation.adjustment.block import Block, State
from georef.estimation.adjustment.equations.block_cholesky import SingularMatrix
from georef.estimation.adjustment.equations.cofactors import Cofactors, cofactors
from georef.estimation.adjustment.equations.eliminate import Linearized, normal_equations
from georef.estimation.adjustment.equations.prepared import Prepared
from georef.estimation.adjustment.quality.components import Component
from georef.estimation.adjustment.quality.group_tests import (
    ImageTests,
    TermTests,
    components,
    constraint_tests,
    image_tests,
)
from georef.estimation.adjustment.quality.reference_part import ReferencePart
from georef.estimation.datum.singular import explain_singular


@dataclass(frozen=True, eq=False)
class Quality:
    """Cofactors and tests of a block at a state."""

    cofactors: Cofactors
    images: ImageTests
    constraints: list[TermTests]
    components: dict[str, Component]
    references: ReferencePart | None  # what the errors of reference images add through automatic GCPs


def quality(block: Block, state: State, prepared: Prepared | None = None) -> Quality:
    """Cofactors, tests and variance components at a state, for the stated sigmas. Raises GeorefError where the normal
    equations are singular."""
    prepared = prepared or Prepared.of(block)
    found = inverted(block, state, normal_equations(block, state, prepared=prepared), prepared)
    images = image_tests(block, state, found, prepared)
    references = ReferencePart.of(block, state, found)
    tests = constraint_tests(block, state, found, images.points, references)
    return Quality(found, images, tests, components(block, state, images, tests), references)


def inverted(block: Block, state: State, lin: Linearized, prepared: Prepared) -> Cofactors:
    """The inverse of normal equations; GeorefError with what is missing where they are singular."""
    try:
        return cofactors(lin.reduced, prepared.pattern)
    except SingularMatrix:
        words = explain_singular(block, state, lin.reduced)
        raise GeorefError(
            words or "The adjustment has no unique solution: its constraints leave unknowns open."
        ) from None
