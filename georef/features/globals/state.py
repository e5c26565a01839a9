"""What a descriptor learned from the reference map, as one small safetensors file."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from georef.errors import StageError
from georef.replacing import replacing

_FORMAT = "georef.global-descriptor.1"


@dataclass(frozen=True, eq=False)
class LearnedState:
    """Arrays by name, and what learned them: a descriptor's name with the settings that shape the arrays."""

    learned_by: str
    arrays: Mapping[str, NDArray]

    @cached_property
    def sha256(self) -> str:
        """Hash of all that is in it; it stands in the descriptor's version."""
        digest = hashlib.sha256(self.learned_by.encode())
        for name in sorted(self.arrays):
            array = np.ascontiguousarray(self.arrays[name])
            digest.update(f"|{name} {array.dtype.str} {array.shape}|".encode())
            digest.update(array.tobytes())
        return digest.hexdigest()

    def save(self, path: Path) -> None:
        """Write the file whole, or not at all."""
        metadata = {"format": _FORMAT, "learned_by": self.learned_by, "sha256": self.sha256}
        with replacing(path) as temporary:
            save_file({k: np.ascontiguousarray(v) for k, v in self.arrays.items()}, temporary, metadata=metadata)

    @staticmethod
    def load(path: Path) -> LearnedState:
        """Read the file. Raises StageError where it is missing, damaged or of another format."""
        remedy = f"Learn it again from the reference map.\nIn {path}"
        if not path.is_file():
            raise StageError(f"There is no learned state of a global descriptor.\n{remedy}")
        try:
            with safe_open(path, framework="numpy") as stored:
                metadata = stored.metadata() or {}
                state = LearnedState(metadata.get("learned_by", ""), {k: stored.get_tensor(k) for k in stored.keys()})  # noqa: SIM118
        except (SafetensorError, OSError) as error:
            raise StageError(f"The learned state of a global descriptor is damaged: {error}.\n{remedy}") from error
        if metadata.get("format") != _FORMAT or metadata.get("sha256") != state.sha256:
            problem = "has another format" if metadata.get("format") != _FORMAT else "does not have the hash it states"
            raise StageError(f"The learned state of a global descriptor {problem}.\n{remedy}")
        return state

    def check_learned_by(self, expected: str) -> None:
        """Raises StageError where another descriptor, or the same with other settings, learned this."""
        if self.learned_by != expected:
            raise StageError(
                f"The state was learned by '{self.learned_by}', expected '{expected}'.\n"
                "Learn it again from the reference map."
            )
