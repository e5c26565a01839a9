"""The precomputed map on disk: one file a reference image, with all that localization needs of its points."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from georef.errors import StageError
from georef.io.items import read_item, write_item
from georef.types.features import Matches
from georef.types.scene import ImageStructure, Observations


def write_matches(path: Path, matches: Mapping[str, Matches], keys: Mapping[str, str] | None = None) -> None:
    """Stores the matches of one image with others, by their names; keys say what a pair was matched from."""
    arrays: dict[str, np.ndarray] = {}
    for number, found in enumerate(matches.values()):
        arrays |= {f"matches_{number}": found.indices, f"scores_{number}": found.scores.astype(np.float16)}
    header = {"partners": list(matches), "keys": [(keys or {}).get(name, "") for name in matches]}
    write_item(path, header, arrays)


def read_matches(path: Path, known: Collection[str] | None = None) -> tuple[list[str], list[Matches]]:
    """The names of an image's partners, and its matches with each; with `known` those of these keys alone.

    Raises StageError for a file that is missing or damaged.
    """
    header, arrays = read_item(path)
    wanted = [k for k, key in enumerate(header["keys"]) if known is None or key in known]
    found = [Matches(arrays[f"matches_{k}"], arrays[f"scores_{k}"].astype(np.float32)) for k in wanted]
    return [header["partners"][k] for k in wanted], found


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
            "Delete the folder of the stage that made it and run again.",
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
