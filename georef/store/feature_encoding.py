"""The arrays that a file of local features holds: exact, or with descriptors in seven bits a value.

| array | exact | quantized |
|---|---|---|
| keypoints_px (N, 2) | float32 | float32 |
| colors_rgb (N, 3) | uint8 | uint8 |
| scores (N,) | float32 | float16 where all fit into it |
| scales_px | as below | as below |
| orientations_rad (N,), where there are any | float32 | float32 |
| descriptors (N, D) | as they came | uint8 as they came; others as descriptor_codes, descriptor_factors |

`quantization` says what codes (N, B) uint8 and factors (N,) float32 are.
Scales are exact in both: detectors that work in a few levels have few, and then scale_values (K,) holds the different
ones and scale_codes (N,) uint8 says which (left out where there is one); with more than 256, scales_px (N,) float32.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from georef.store.quantization import BITS, pack_rows, unpack_rows
from georef.types.features import Features

EXACT = "exact"
QUANTIZED = f"{BITS} bits"
_MOST_CODES = 256
_WHOLE = {"scale_values"}  # not one row a keypoint

Arrays = dict[str, np.ndarray]


def encode(features: Features, quantize: bool) -> tuple[Arrays, dict[str, str]]:
    """The arrays of a file, and what its header must say to read them again.

    Raises ValueError for descriptors that are not finite where they would be quantized.
    """
    descriptors: np.ndarray = np.ascontiguousarray(features.descriptors)
    arrays = {
        "keypoints_px": np.ascontiguousarray(features.keypoints_px, np.float32),
        "colors_rgb": np.ascontiguousarray(features.colors_rgb, np.uint8),
        "scores": _scores(np.ascontiguousarray(features.scores, np.float32), quantize),
        **_scales(np.ascontiguousarray(features.scales_px, np.float32)),
    }
    if features.orientations_rad is not None:
        arrays["orientations_rad"] = np.ascontiguousarray(features.orientations_rad, np.float32)
    if quantize and np.issubdtype(descriptors.dtype, np.floating):
        arrays["descriptor_codes"], arrays["descriptor_factors"] = pack_rows(descriptors)
    else:
        arrays["descriptors"] = descriptors
    header = {
        "encoding": QUANTIZED if quantize else EXACT,
        "descriptor_size": str(descriptors.shape[1]),
        "descriptor_dtype": descriptors.dtype.name,
        "quarter_turns": str(features.quarter_turns),
    }
    return arrays, header


def decode(
    stored: Mapping[str, Callable[[int | None], np.ndarray]], header: Mapping[str, str], count: int | None
) -> Features:
    """The `count` best features, or all, from functions that read the first rows of each array that there is."""
    arrays = {name: read(None if name in _WHOLE else count) for name, read in stored.items()}
    keypoints = arrays["keypoints_px"]
    return Features(
        image_size=(int(header["image_width"]), int(header["image_height"])),
        keypoints_px=keypoints,
        scores=arrays["scores"].astype(np.float32, copy=False),
        scales_px=_read_scales(arrays, len(keypoints)),
        descriptors=_read_descriptors(arrays, header),
        colors_rgb=arrays["colors_rgb"],
        orientations_rad=arrays.get("orientations_rad"),
        quarter_turns=int(header.get("quarter_turns", "0")),  # files written before it was said were not turned
    )


def _scores(scores: NDArray[np.float32], quantize: bool) -> NDArray[np.floating]:
    if quantize and np.abs(scores).max(initial=0.0) <= np.finfo(np.float16).max:
        return scores.astype(np.float16)
    return scores


def _scales(scales_px: NDArray[np.float32]) -> Arrays:
    values, codes = np.unique(scales_px, return_inverse=True)
    if len(values) > _MOST_CODES:
        return {"scales_px": scales_px}
    one = {"scale_values": values}
    return one if len(values) <= 1 else one | {"scale_codes": codes.astype(np.uint8)}


def _read_scales(arrays: Arrays, count: int) -> NDArray[np.float32]:
    if "scales_px" in arrays:
        return arrays["scales_px"]
    values = arrays["scale_values"]
    if "scale_codes" in arrays:
        return values[arrays["scale_codes"]]
    return np.full(count, values[0] if count else 0, np.float32)


def _read_descriptors(arrays: Arrays, header: Mapping[str, str]) -> np.ndarray:
    if "descriptors" in arrays:
        return arrays["descriptors"]
    size, dtype = int(header["descriptor_size"]), np.dtype(header["descriptor_dtype"])
    return unpack_rows(arrays["descriptor_codes"], arrays["descriptor_factors"], size, dtype)
