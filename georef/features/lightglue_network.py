"""The pass through LightGlue's network, written for few operations on the CPU; same output as kornia's module.

Two things differ from the usual form. Attention is the fused kind in both directions (the usual cross attention keeps
the matrix of weights, at twice the time). The rows that make queries and keys are sorted once, so that the components
that turn together lie half a head apart; the products of queries and keys do not see that.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import gelu, layer_norm, linear, log_softmax, logsigmoid, scaled_dot_product_attention


class LightGlueNetwork:
    """Weights by name, in the precision of the layers; angles and log scores are always formed in float32.

    Width, heads and layers follow from the weights: LightGlue has 256, 4 and 9, LighterGlue 96, 1 and 6.
    """

    def __init__(self, weights: dict[str, Tensor], *, dtype: torch.dtype, device: torch.device) -> None:
        named = {_current_name(key): tensor for key, tensor in weights.items()}
        self._layers = len({key.split(".")[1] for key in named if key.startswith("transformers.")})
        width, turns = named["transformers.0.self_attn.out_proj.weight"].shape[0], named["posenc.Wr.weight"].shape[0]
        self._heads = width // (2 * turns)
        named.update(_split_query_key_value(named, self._layers, self._heads))
        self._weights = {key: tensor.to(device, _dtype_of(key, dtype)) for key, tensor in named.items()}
        self._dtype = dtype

    def log_assignment(self, places_a: Tensor, rows_a: Tensor, places_b: Tensor, rows_b: Tensor) -> Tensor:
        """Logarithm (N, M) of the score of every pair, float32.

        places (N, P), (M, P): keypoints from the image's centre in units of half its longest side; where the weights
        want P = 4, also their scales and orientations. rows (N, D), (M, D): descriptors of unit length.
        """
        turn_a, turn_b = self._turns(places_a), self._turns(places_b)
        a, b = (self._projected(rows.to(self._dtype)) for rows in (rows_a, rows_b))
        for layer in range(self._layers):
            name = f"transformers.{layer}.self_attn"
            a, b = self._attend_self(name, a, turn_a), self._attend_self(name, b, turn_b)
            a, b = self._attend_cross(f"transformers.{layer}.cross_attn", a, b)
        return self._assign(f"log_assignment.{self._layers - 1}", a.float(), b.float())

    def _projected(self, rows: Tensor) -> Tensor:
        """Descriptors brought to the width of the layers; those that have it already come as they are."""
        return self._linear("input_proj", rows) if "input_proj.weight" in self._weights else rows

    def _linear(self, name: str, rows: Tensor) -> Tensor:
        return linear(rows, self._weights[f"{name}.weight"], self._weights[f"{name}.bias"])

    def _turns(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Cosines and sines (1, N, d/2) of the angles by which a place turns queries and keys."""
        angles = linear(places, self._weights["posenc.Wr.weight"])[None]
        return angles.cos().to(self._dtype), angles.sin().to(self._dtype)

    def _attend_self(self, name: str, rows: Tensor, turns: tuple[Tensor, Tensor]) -> Tensor:
        query, key, value = (self._split(self._linear(f"{name}.{part}", rows)) for part in ("query", "key", "value"))
        found = _attention(_turned(query, turns), _turned(key, turns), value)
        return self._feed_forward(name, rows, self._linear(f"{name}.out_proj", found))

    def _attend_cross(self, name: str, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        key_a, key_b = (self._split(self._linear(f"{name}.to_qk", rows)) for rows in (a, b))
        value_a, value_b = (self._split(self._linear(f"{name}.to_v", rows)) for rows in (a, b))
        found_a = self._linear(f"{name}.to_out", _attention(key_a, key_b, value_b))
        found_b = self._linear(f"{name}.to_out", _attention(key_b, key_a, value_a))
        return self._feed_forward(name, a, found_a), self._feed_forward(name, b, found_b)

    def _split(self, rows: Tensor) -> Tensor:
        return rows.unflatten(-1, (self._heads, -1)).transpose(0, 1)  # (H, N, d)

    def _feed_forward(self, name: str, rows: Tensor, message: Tensor) -> Tensor:
        wide = self._linear(f"{name}.ffn.0", torch.cat([rows, message], -1))
        norm = self._weights[f"{name}.ffn.1.weight"], self._weights[f"{name}.ffn.1.bias"]
        return rows + self._linear(f"{name}.ffn.3", gelu(layer_norm(wide, wide.shape[-1:], *norm)))

    def _assign(self, name: str, a: Tensor, b: Tensor) -> Tensor:
        """Similarity softmaxed both ways, times both matchabilities; as logarithms."""
        projected_a, projected_b = (self._linear(f"{name}.final_proj", rows) for rows in (a, b))
        similar = projected_a @ projected_b.T / a.shape[-1] ** 0.5
        matchable_a, matchable_b = (logsigmoid(self._linear(f"{name}.matchability", rows)) for rows in (a, b))
        return log_softmax(similar, 1) + log_softmax(similar, 0) + matchable_a + matchable_b.T


def _attention(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    found = scaled_dot_product_attention(query[None], key[None], value[None])[0]
    return found.transpose(0, 1).flatten(-2)  # (N, D)


def _turned(vectors: Tensor, turns: tuple[Tensor, Tensor]) -> Tensor:
    cosine, sine = turns
    first, second = vectors.chunk(2, -1)
    return torch.cat([first * cosine - second * sine, second * cosine + first * sine], -1)


def _current_name(key: str) -> str:
    """Older files say `self_attn.3.x` and `cross_attn.3.x` for what stands in layer 3 of the transformers; training
    leaves `matcher.` before all names."""
    key = key.removeprefix("matcher.")
    block, _, rest = key.partition(".")
    if block not in ("self_attn", "cross_attn"):
        return key
    layer, _, rest = rest.partition(".")
    return f"transformers.{layer}.{block}.{rest}"


def _split_query_key_value(named: dict[str, Tensor], layers: int, heads: int) -> dict[str, Tensor]:
    """Three linear maps from the one whose rows run over (head, component, query/key/value)."""
    split: dict[str, Tensor] = {}
    for layer in range(layers):
        name = f"transformers.{layer}.self_attn"
        for kind in ("weight", "bias"):
            parts = named[f"{name}.Wqkv.{kind}"].unflatten(0, (heads, -1, 3))
            query, key, value = parts.unbind(2)
            apart = torch.cat([torch.arange(0, query.shape[1], 2), torch.arange(1, query.shape[1], 2)])
            split[f"{name}.query.{kind}"] = query[:, apart].flatten(0, 1).contiguous()
            split[f"{name}.key.{kind}"] = key[:, apart].flatten(0, 1).contiguous()
            split[f"{name}.value.{kind}"] = value.flatten(0, 1).contiguous()
    return split


def _dtype_of(key: str, dtype: torch.dtype) -> torch.dtype:
    return torch.float32 if key.startswith(("posenc.", "log_assignment.")) else dtype
