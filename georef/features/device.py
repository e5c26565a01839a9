"""Where the learned components compute."""

from __future__ import annotations

import torch


def choose_device(device: str) -> torch.device:
    """The device of that name; "auto" is "cuda" where there is one and "cpu" elsewhere."""
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(device)
