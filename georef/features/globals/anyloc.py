"""AnyLoc-VLAD (Keetha et al. 2023): VLAD of DINOv2's values, over a vocabulary that its authors publish."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn.functional import normalize, one_hot

from georef.errors import WeightsError
from georef.features.globals.base import normalized, square_input
from georef.features.globals.loading import build, tensors_of
from georef.features.globals.pixels import PixelDescriptor
from georef.features.globals.vision_transformer import VIT_G14, VisionTransformer
from georef.features.weights import load_state_dict

LAYER = 31
CENTRES = 32
BACKBONE = "dinov2-vitg14"


def anyloc(*, vocabulary: str = "urban", device: str = "cpu") -> PixelDescriptor:
    """AnyLoc with DINOv2 ViT-g/14, rows (49152,), at 322 x 322; 4 GB of weights.

    vocabulary: the domain of the centres ("urban", "indoor", "aerial", "structured", "unstructured", "global").
    Raises WeightsError where weights are not in the cache, or there are none of that domain.
    """
    centres = load_centres(f"anyloc-{vocabulary}", VIT_G14.width)
    network = AnyLocNetwork(build(lambda: VisionTransformer(VIT_G14), tensors_of(BACKBONE), BACKBONE), centres, LAYER)
    weights = [BACKBONE, f"anyloc-{vocabulary}"]
    return PixelDescriptor("anyloc", centres.numel(), network, square_input, weights, device)


def load_centres(weights: str, width: int) -> Tensor:
    """The centres (32, width) of a published vocabulary. Raises WeightsError where the file holds something else."""
    centres = load_state_dict(weights)
    if not isinstance(centres, Tensor) or centres.shape != (CENTRES, width):
        found = tuple(centres.shape) if isinstance(centres, Tensor) else type(centres).__name__
        raise WeightsError(f"Weights '{weights}' are {found}, expected a tensor ({CENTRES}, {width}).")
    return centres.float()


class AnyLocNetwork(nn.Module):
    """Rows (N, K x width) of images; the blocks after the one whose values are taken are let go."""

    def __init__(self, backbone: VisionTransformer, centres: Tensor, layer: int) -> None:
        super().__init__()
        del backbone.blocks[layer + 1 :]
        self._backbone, self._layer = backbone, layer
        self.register_buffer("_centres", centres)
        self._centres: Tensor

    def forward(self, image: Tensor) -> Tensor:
        return hard_vlad(normalize(self._backbone.values(normalized(image), self._layer), dim=-1), self._centres)


def hard_vlad(rows: Tensor, centres: Tensor) -> Tensor:
    """Unit VLADs (N, K x D) of unit rows (N, P, D): residuals from the centre (K, D) of the most similar direction."""
    nearest = (rows @ normalize(centres, dim=1).T).argmax(-1)
    held = one_hot(nearest, len(centres)).to(rows.dtype)
    sums = held.transpose(1, 2) @ rows - held.sum(1)[:, :, None] * centres
    return normalize(normalize(sums, dim=-1).flatten(1))
