"""Published weights into our modules: every tensor of the file has its place, and every place its tensor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from georef.errors import WeightsError
from georef.features.weights import load_state_dict

Module = TypeVar("Module", bound=nn.Module)

_NAMED = 4  # keys that a message names


def build(make: Callable[[], Module], tensors: Mapping[str, Tensor], weights: str) -> Module:
    """The module that `make` describes with these tensors for its parameters and buffers, float32, for inference.

    The module is made without memory of its own. weights: the entry of the weights table, for messages.
    Raises WeightsError for tensors that are missing, left over, or of another shape.
    """
    with torch.device("meta"):
        module = make()
    expected = {key: tuple(value.shape) for key, value in module.state_dict().items()}
    _check(expected, tensors, weights)
    floats = {key: value.float() if value.is_floating_point() else value for key, value in tensors.items()}
    module.load_state_dict(floats, assign=True)
    return module.requires_grad_(False).eval()


def tensors_of(weights: str) -> dict[str, Tensor]:
    """Tensors of a published file by name; the checkpoint of a training framework is opened at its `state_dict`.

    Raises WeightsError where the file holds something else.
    """
    loaded: Any = load_state_dict(weights)
    if isinstance(loaded, dict) and isinstance(loaded.get("state_dict"), dict):
        loaded = loaded["state_dict"]
    if not isinstance(loaded, dict) or not all(isinstance(value, Tensor) for value in loaded.values()):
        raise WeightsError(f"Weights '{weights}' are not a table of tensors, but {type(loaded).__name__}.")
    return loaded


def _check(expected: Mapping[str, tuple[int, ...]], tensors: Mapping[str, Tensor], weights: str) -> None:
    shapes = {key: tuple(value.shape) for key, value in tensors.items()}
    problems = {
        "missing": [key for key in expected if key not in shapes],
        "left over": [key for key in shapes if key not in expected],
        "of another shape": [
            f"{key} {shapes[key]} instead of {shape}"
            for key, shape in expected.items()
            if key in shapes and shapes[key] != shape
        ],
    }
    lines = [f"{what}: {_listed(keys)}" for what, keys in problems.items() if keys]
    if lines:
        raise WeightsError(
            f"Weights '{weights}' do not fit the network: {len(shapes)} tensors, expected {len(expected)}.",
            *lines,
            "Fetch the file that the table of weights names.",
        )


def _listed(keys: list[str]) -> str:
    more = f" and {len(keys) - _NAMED} more" if len(keys) > _NAMED else ""
    return ", ".join(keys[:_NAMED]) + more
