"""A simulated recording: the folder of a bag with scene, sensor and truth of every frame."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

from cmp_tactile_bringup.recordings import library
from cmp_tactile_processing.measured import ForceField
from cmp_tactile_simulation.recording.truth import RecordedTruth, read_true_force, read_truth
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import SCENE_FILE, SENSOR_FILE, read_scene


@dataclass(frozen=True)
class Phase:
    """A part of the recording: its name and its first frame (counted from 0)."""

    name: str
    first_frame: int


@dataclass(frozen=True)
class Recording:
    """A simulated bag and what is true of it.  sensor: file of its description."""

    bag: Path
    truth: RecordedTruth
    sensor: str
    title: str
    phases: tuple[Phase, ...]

    def true_force(self, index: int) -> ForceField:
        """The true force field of a frame."""
        return read_true_force(self.bag, int(self.truth.stamp_ns[index]))


def find_recording(
    name_or_path: str = library.DEFAULT_SCENE, progress: library.MakingProgress | None = None
) -> Recording:
    """The recording of a packaged scene, or the one in the folder that is given, with its truth.

    Raises RecordingError where it is not a simulated recording, CmpTactileError where a file of it
    cannot be used.
    """
    bag = library.recorded_source(Path(name_or_path), progress)
    for name in ("metadata.yaml", SCENE_FILE, SENSOR_FILE):
        if not (bag / name).is_file():
            msg = f"{bag}: found no {name}, expected a recording from `cmp_tactile simulate`"
            raise library.RecordingError(msg)
    scene = read_scene(bag / SCENE_FILE)
    return Recording(
        bag=bag,
        truth=read_truth(bag),
        sensor=str(bag / SENSOR_FILE),
        title=scene.title,
        phases=_phases(scene),
    )


def _phases(scene: Scene) -> tuple[Phase, ...]:
    starts = [0, *accumulate(phase.frames for phase in scene.motion)]
    return tuple(
        Phase(phase.name, start) for phase, start in zip(scene.motion, starts[:-1], strict=True)
    )
