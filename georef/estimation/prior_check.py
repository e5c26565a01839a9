"""A localized pose against the position prior of its image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from georef.config import LocalizeConfig
from georef.geometry.covariance import position_cov_in_world
from georef.types.campaign import Image
from georef.types.results import Outcome, Rejected, RejectReason

_PRIOR_PROBABILITY = 0.9999
STRONG_EVIDENCE = 3  # times min_inliers: then the images overrule a position prior


def against_prior(outcome: Outcome, image: Image, config: LocalizeConfig) -> Outcome:
    """Compares a pose with the position prior: strong evidence overrules the prior, weak evidence does not."""
    if isinstance(outcome, Rejected) or image.gnss is None:
        return outcome
    off = outcome.world_from_cam.translation - image.gnss.position_in_world
    cov = image.gnss.cov + position_cov_in_world(outcome.world_from_cam, outcome.world_from_cam_cov)
    if off @ np.linalg.solve(cov, off) <= chi2.ppf(_PRIOR_PROBABILITY, 3):
        return outcome
    distance = float(np.linalg.norm(off))
    if outcome.correspondence_count < STRONG_EVIDENCE * config.min_inliers:
        detail = f"{outcome.correspondence_count} points put it {distance:.1f} m from its position prior"
        return Rejected(image.image_id, RejectReason.PRIOR_CONTRADICTS, detail)
    return replace(outcome, gnss_rejected=True, gnss_offset_m=distance)
