"""The mechanical states of an unfinished run, kept so that it can go on where it stopped."""

from __future__ import annotations

import logging
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.files import atomic_path
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose
from cmp_tactile_simulation.scenes.description import PhaseStart
from cmp_tactile_simulation.scenes.simulation import MechanicalState

LOGGER = logging.getLogger(__name__)
# One would do; the others are for files that a failing disk has damaged.
KEPT = 10
MEMORY = "memory_"
STATE_ARRAYS = ("force", "displacement", "gap", "contact", "slipping")


class Checkpoints:
    """Files of the newest states in a folder, lossless; each appears whole or not at all."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def save(self, state: MechanicalState) -> None:
        """Keep a state, and forget the oldest."""
        with atomic_path(self._path(state.frame)) as beside, beside.open("wb") as file:
            np.savez(file, allow_pickle=False, **_arrays(state))
        self._path(state.frame - KEPT).unlink(missing_ok=True)

    def newest(self, frame: int) -> MechanicalState | None:
        """The newest state that can be read of those up to a frame."""
        for path in self._files(frame):
            state = _read_state(path)
            if state is not None:
                return state
        return None

    def _path(self, frame: int) -> Path:
        return self._folder / f"state_{frame:08d}.npz"

    def _files(self, frame: int) -> Iterator[Path]:
        last = self._path(frame).name
        paths = sorted(self._folder.glob("state_*.npz"), reverse=True)
        return (path for path in paths if path.name <= last)


def _arrays(state: MechanicalState) -> dict[str, NDArray[Any]]:
    contact, start = state.contact, state.phase_start
    load = start.load
    return {
        "frame": np.array(state.frame),
        **{name: getattr(contact, name) for name in STATE_ARRAYS},
        "position": contact.pose.position,
        "rotation": contact.pose.rotation,
        "start_position": start.pose.position,
        "start_rotation": start.pose.rotation,
        "start_load": np.array([load.normal, *load.tangential, load.torque]),
        **{f"{MEMORY}{name}": values for name, values in state.memory.items()},
    }


def _read_state(path: Path) -> MechanicalState | None:
    """The state of a file; None, with a line in the log, where it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return _state({name: file[name] for name in file.files})
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        LOGGER.warning("%s: cannot be used; an earlier checkpoint is used: %s", path, error)
        return None


def _state(arrays: dict[str, NDArray[Any]]) -> MechanicalState:
    normal, x, y, torque = arrays["start_load"].tolist()
    return MechanicalState(
        frame=int(arrays["frame"]),
        contact=ContactState(
            pose=Pose(arrays["position"], arrays["rotation"]),
            **{name: arrays[name] for name in STATE_ARRAYS},
        ),
        phase_start=PhaseStart(
            Pose(arrays["start_position"], arrays["start_rotation"]), Load(normal, (x, y), torque)
        ),
        memory={
            name.removeprefix(MEMORY): values
            for name, values in arrays.items()
            if name.startswith(MEMORY)
        },
    )
