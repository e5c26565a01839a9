"""What extractors that are networks have in common: pixels in, detections out."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from georef.features.detections import Detections, Image
from georef.features.weights import version_tag


def version_of(name: str, weights: str, settings: str) -> str:
    """What decides the result of a network: its own version, torch, the weights, its settings."""
    return f"{name}-1 torch={torch.__version__} weights={version_tag(weights)} {settings}"


def image_tensor(image_rgb: Image, device: torch.device) -> Tensor:
    """An image (H, W, 3) as (3, H, W) float32 in [0, 1] on the device."""
    return torch.from_numpy(np.ascontiguousarray(image_rgb)).to(device).permute(2, 0, 1).float() / 255


def detections_of(keypoints: Tensor, scores: Tensor, descriptors: Tensor) -> Detections:
    """Detections from keypoints (N, 2), the top-left pixel's centre at (0, 0); the scale is one pixel of the level."""
    return Detections(
        keypoints_px=keypoints.cpu().numpy() + np.float32(0.5),
        scores=scores.cpu().numpy(),
        scales_px=np.ones(len(scores), np.float32),
        descriptors=descriptors.half().cpu().numpy(),
    )
