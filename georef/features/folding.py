"""Batch normalisation with fixed statistics made part of the convolution before it."""

from __future__ import annotations

from torch import Tensor

EPSILON = 1e-5


def fold(weights: dict[str, Tensor], conv: str, norm: str) -> dict[str, Tensor]:
    """Weight and bias of a convolution and the normalisation after it, by the names of the convolution.

    weights: has `<conv>.weight`, no bias, and `<norm>.running_mean` and kin; scale and shift of the normalisation may
    be missing.
    """
    factor = (weights[f"{norm}.running_var"] + EPSILON).rsqrt()
    if f"{norm}.weight" in weights:
        factor = factor * weights[f"{norm}.weight"]
    bias = -weights[f"{norm}.running_mean"] * factor
    if f"{norm}.bias" in weights:
        bias = bias + weights[f"{norm}.bias"]
    return {f"{conv}.weight": weights[f"{conv}.weight"] * factor[:, None, None, None], f"{conv}.bias": bias}
