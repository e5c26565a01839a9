"""The precomputed map on disk: one file a reference image, with all that localization needs of its points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from georef.errors import StageError
from georef.io.items import read_item, write_item
from georef.types.scene import ImageStructure, Observations


def write_structure(path: Path, structure: ImageStructure, image_ids: Sequence[str]) -> None:
    """Stores the structure of one image; image_ids name all references, by their place."""
    obs = structure.observations
    used, view = np.unique(obs.view, return_inverse=True)
    local = {int(image): k for k, image in enumerate(used)}
    arrays = {
        "keypoint": structure.keypoint,
        "identity_image": np.array([local[int(image)] for image in structure.identity[:, 0]], dtype=np.int32),
        "identity_keypoint": structure.identity[:, 1].astype(np.int32),
        "points": structure.points,
        "cov": structure.cov.astype(np.float32),
        "point": obs.point.astype(np.int32),
        "view": view.astype(np.int32),
        "pixel": obs.pixel.astype(np.float32),
        "sigma_px": obs.sigma_px.astype(np.float32),
        "observed_keypoint": obs.keypoint.astype(np.int32),
    }
    write_item(path, {"images": [image_ids[int(image)] for image in used]}, arrays)


def read_structure(path: Path, places: Mapping[str, int]) -> ImageStructure:
    """The structure of one image; places tells where each reference stands now. Raises StageError."""
    header, arrays = read_item(path)
    unknown = [name for name in header["images"] if name not in places]
    if unknown:
        raise StageError(
            f"The precomputed map has points of reference image '{unknown[0]}', which takes no part now.",
            "Delete the folder of the stage `global-map` and run again.",
            f"In {path}.",
        )
    place = np.array([places[name] for name in header["images"]], dtype=np.int64)
    identity = np.column_stack([place[arrays["identity_image"]], arrays["identity_keypoint"].astype(np.int64)])
    observations = Observations(
        arrays["point"].astype(np.int64),
        place[arrays["view"]],
        arrays["pixel"].astype(np.float64),
        arrays["sigma_px"].astype(np.float64),
        arrays["observed_keypoint"].astype(np.int64),
    )
    return ImageStructure(
        arrays["keypoint"], identity, arrays["points"], arrays["cov"].astype(np.float64), observations
    )
