"""Solves of an adjustment on disk, a file each, so that an interrupted one goes on from its last iteration."""

from __future__ import annotations

import logging
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from georef.errors import StageError
from georef.estimation.adjustment.block import State
from georef.estimation.adjustment.campaign.checkpoints import Reached
from georef.estimation.adjustment.solver import BlockSolution
from georef.geometry.camera import Camera
from georef.geometry.poses import Poses
from georef.io.items import camera_of, item_path, read_item, write_item

_log = logging.getLogger(__name__)
SOLVES = "solves"
"""Name of the folder, beside what is made of them."""


@dataclass(frozen=True)
class SolveFiles:
    """`Checkpoints` in a folder. A damaged file counts as none."""

    folder: Path

    def read(self, key: str) -> Reached | None:
        path = item_path(self.folder, key)
        if not path.exists():
            return None
        try:
            header, arrays = read_item(path)
        except StageError as error:
            _log.warning("%s", error)
            return None
        state = state_of(header["cameras"], arrays)
        numbers = (header[name] for name in ("cost", "iterations", "converged", "hidden", "undetermined"))
        return Reached(BlockSolution(state, *numbers), header["finished"], header["damping"])

    def write(self, key: str, reached: Reached) -> None:
        solution = reached.solution
        header = {
            "cost": solution.cost,
            "iterations": solution.iterations,
            "converged": solution.converged,
            "hidden": solution.hidden,
            "undetermined": solution.undetermined,
            "finished": reached.finished,
            "damping": reached.damping,
            "cameras": [asdict(camera) for camera in solution.state.cameras],
        }
        write_item(item_path(self.folder, key), header, arrays_of(solution.state))

    def clear(self) -> None:
        """Forgets all solves: the adjustment that they belong to is done and stored."""
        shutil.rmtree(self.folder, ignore_errors=True)


def arrays_of(state: State) -> dict[str, np.ndarray]:
    """A state without its cameras."""
    return {
        "rig_rotation": state.world_from_rig.rotation,
        "rig_translation": state.world_from_rig.translation,
        "cam_rotation": state.rig_from_cam.rotation,
        "cam_translation": state.rig_from_cam.translation,
        "lever_arms_m": state.lever_arms_m,
        "drift_m": state.drift_m,
        "points": state.points,
    }


def state_of(cameras: list[dict[str, object]], arrays: dict[str, np.ndarray]) -> State:
    """The state of stored arrays and cameras."""
    found: list[Camera] = [camera_of(camera) for camera in cameras]
    return State(
        Poses(arrays["rig_rotation"], arrays["rig_translation"]),
        Poses(arrays["cam_rotation"], arrays["cam_translation"]),
        tuple(found),
        arrays["lever_arms_m"],
        arrays["drift_m"],
        arrays["points"],
    )
