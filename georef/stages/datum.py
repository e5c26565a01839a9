"""Do map, GNSS and surveyed control agree on where the epoch is? Asked before the adjustment starts."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from georef.errors import InputError
from georef.estimation.datum.pairs import CONTROL, GNSS, Origin, contradiction, control_pairs, gnss_pairs
from georef.estimation.datum.sentinel import DatumReport, Finding, Paired, compare_datums
from georef.geometry.rigid import Array
from georef.stages.base import StageContext
from georef.types.campaign import Image
from georef.types.results import Localized

_GROSS: set[str] = {
    *("axes swapped", "handedness", "axes turned", "heights reversed", "feet", "wrong zone", "false origin"),
}
_CONTRADICTION = 5.0
"""Sigmas, stated and shared, that sources must typically differ by before a finding stops the adjustment."""
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Source:
    """A source beside the map: whether it takes part in the adjustment, and the file that it comes from."""

    name: str
    takes_part: bool
    path: Path


def check_datum(
    context: StageContext,
    images: Sequence[Image],
    localized: Sequence[Localized],
    lever_arms_m: Sequence[Array],
    offset_sigma_m: float = 0.0,
) -> dict[str, Any]:
    """What separates GNSS and control from the map, for the report. All sequences in one order; see `gnss_pairs`.

    Raises InputError where a source that takes part contradicts the map beyond its stated sigmas, or for a reason that
    no sigma covers (axes, units, zones), unless `adjust.accept_datum` names the finding.
    """
    config, section = context.config.adjust, context.project.file.epochs[context.epoch]
    origin, comparisons = _origin(context), []
    if section.gnss is not None:
        source = _Source(GNSS, config.gnss, context.project.data(section.gnss))
        paired = gnss_pairs(images, localized, lever_arms_m, offset_sigma_m, origin)
        comparisons.append((source, paired))
    points = context.project.file.points
    if points is not None and context.survey.control:
        source = _Source(CONTROL, config.surveyed_control, context.project.data(points.coordinates))
        comparisons.append((source, control_pairs(context.survey.control, images, localized, origin)))
    found = [(source, paired, compare_datums(paired)) for source, paired in comparisons if paired is not None]
    for source, paired, report in found:
        _refuse(source, paired, report, config.accept_datum, _others_agree(found, source))
    return {"comparisons": [_plain(source, report, config.accept_datum) for source, _, report in found]}


def _refuse(source: _Source, paired: Paired, report: DatumReport, accepted: Sequence[str], beside: str) -> None:
    """Raises for the first finding that is certain and not accepted; says the others. beside: what else is known."""
    for finding in report.findings:
        if finding.kind in accepted:
            logger.warning("accepted: %s", finding.text)
        elif source.takes_part and _certain(finding, paired):
            words = " ".join((finding.text, *finding.alternatives, beside)).strip()
            switch = "adjust.gnss=false" if source.name == GNSS else "adjust.surveyed_control=false"
            raise InputError(
                words,
                expected=f"{source.name} that agrees with the map within the stated sigmas.",
                remedy=f"{finding.remedy}\nTo go on all the same: --set adjust.accept_datum='[\"{finding.kind}\"]', or "
                f"without it: --set {switch}.",
                path=source.path,
            )
        else:
            logger.warning("%s %s", finding.text, finding.remedy)


def _certain(finding: Finding, paired: Paired) -> bool:
    """Whether the adjustment cannot start: what no sigma covers, or sources far apart for what they state."""
    if finding.kind in _GROSS:
        return True
    level, height = contradiction(paired)
    return (height if finding.kind.startswith("height") else max(level, height)) > _CONTRADICTION


def _others_agree(found: Sequence[tuple[_Source, Paired, DatumReport]], source: _Source) -> str:
    """Who is alone: where GNSS and control differ from the map in the same way, it is the map."""
    for other, _, report in found:
        if other is source:
            continue
        own = next(r for s, _, r in found if s is source)
        if not report.findings:
            return f"{other.name[0].upper()}{other.name[1:]} and the map agree." if report.pairs >= _ENOUGH else ""
        if _alike(own.findings[0], report.findings[0]) if own.findings else False:
            return f"The same separates the map from {other.name}: it is the reference that differs."
    return ""


_ENOUGH = 4


def _alike(a: Finding, b: Finding) -> bool:
    if a.kind != b.kind or a.value.shape != b.value.shape:
        return False
    return bool((np.abs(a.value - b.value) <= 5.0 * np.hypot(a.sigma, b.sigma) + 1e-9).all())


def _plain(source: _Source, report: DatumReport, accepted: Sequence[str]) -> dict[str, Any]:
    return {
        "source": source.name,
        "pairs": report.pairs,
        "outliers": report.outliers,
        "blind_to": [what for what in report.blind_to if source.name == GNSS or "headings" not in what],
        "findings": [
            {
                "kind": finding.kind,
                "text": " ".join((finding.text, *finding.alternatives)),
                "remedy": finding.remedy,
                "value": finding.value.tolist(),
                "sigma": finding.sigma.tolist(),
                "accepted": finding.kind in accepted,
            }
            for finding in report.findings
        ],
    }


def _origin(context: StageContext) -> Origin:
    """Easting and northing of the origin, and its latitude, where the CRS is projected."""
    described = context.survey.world.describe()
    if described["kind"] != "projected":
        return Origin()
    east, north, _ = described["origin_in_crs"]
    return Origin((float(east), float(north)))
