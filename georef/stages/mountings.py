"""Which images were taken by the cameras of one rig, and how these are mounted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from georef.errors import InputError
from georef.io.gnss import GnssTable
from georef.project import EpochSection
from georef.types.campaign import Campaign, Mounting, PositionPrior

_FREE_OFFSET_M = 100.0  # what localization allows where the offset of GNSS is free


def with_fixes(campaign: Campaign, gnss: GnssTable, section: EpochSection) -> Campaign:
    """The campaign with times of exposure. Where the project declares an antenna or an offset of GNSS, its images have
    sigmas that allow for these, and the positions stand beside as they were measured."""
    times = {name: float(t) for name, t in zip(gnss.image_ids, gnss.times_s, strict=True) if np.isfinite(t)}
    campaign = replace(campaign, times_s=times)
    if section.antenna is None and section.gnss_offset is None:
        return campaign
    wider = np.zeros(3)
    if section.antenna is not None:
        sigma = section.antenna.sigma_m if isinstance(section.antenna.sigma_m, tuple) else (0.0,) * 3
        wider += np.sum(np.square([*section.antenna.lever_arm_m, *sigma]))
    if section.gnss_offset is not None:
        sigma = section.gnss_offset.sigma_m
        wider += np.square(sigma if isinstance(sigma, tuple) else (_FREE_OFFSET_M,) * 3)
    fixes = {image.image_id: image.gnss for image in campaign.images if image.gnss is not None}
    images = tuple(
        replace(image, gnss=PositionPrior(image.gnss.position_in_world, image.gnss.cov + np.diag(wider)))
        if image.gnss is not None
        else image
        for image in campaign.images
    )
    return replace(campaign, images=images, fixes=fixes)


def with_rig(campaign: Campaign, rig: Mapping[str, Mounting], stations: Path, path: Path) -> Campaign:
    """The campaign with the mountings of its stationed images. `stations`: the table that names these, for messages.

    Raises InputError where no image has a station, where a camera is not mounted or twice in a station.
    """
    taken = [image for image in campaign.images if image.station is not None]
    if not taken:
        raise InputError(
            "The epoch has a rig, and no image has a station.",
            expected="a column `station` in the table of positions, equal for the images of one exposure.",
            remedy="Add the column, or leave out `rig` in project.toml.",
            path=stations,
        )
    for image in taken:
        if image.camera.camera_id not in rig:
            raise InputError(
                f"Image '{image.image_id}' belongs to station '{image.station}', and its camera "
                f"'{image.camera.camera_id}' is not mounted.",
                expected=f"one of {', '.join(list(rig)[:5])}.",
                remedy="Add the camera to the table of the rig, or leave the image's station empty.",
                path=path,
            )
    twice = Counter((image.station, image.camera.camera_id) for image in taken).most_common(1)[0]
    if twice[1] > 1:
        station, camera = twice[0]
        raise InputError(
            f"Station '{station}' has {twice[1]} images of camera '{camera}'.",
            expected="one image of each camera in an exposure.",
            remedy="Correct the column `station`.",
            path=stations,
        )
    return replace(campaign, mountings={image.image_id: rig[image.camera.camera_id] for image in taken})
