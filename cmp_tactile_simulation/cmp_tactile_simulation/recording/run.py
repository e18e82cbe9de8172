"""Runs a scene into files, and goes on where an interrupted run stopped."""

from __future__ import annotations

import json
import logging
import zipfile
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.errors import BagError
from cmp_tactile_processing.cache import files
from cmp_tactile_processing.elastic.model import Progress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.state import ContactState, Load, Pose
from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.recording.output_folder import OutputFolder, job_of
from cmp_tactile_simulation.recording.truth import FrameOutput, recorded_frames
from cmp_tactile_simulation.recording.writer import ImageWriter, RecordingWriter, write_video
from cmp_tactile_simulation.scenes.description import PhaseStart, Scene
from cmp_tactile_simulation.scenes.file import load_scene, write_scene
from cmp_tactile_simulation.scenes.simulation import MechanicalState, SimulatedFrame, Simulation

FORMATS = ("bag", "png")
SIMULATING = "simulating"
VIDEO = "drawing the video"
VIDEO_FILE = "video.mp4"


@dataclass(frozen=True)
class RunOptions:
    """format: bag (MCAP) or png (PNG and NPZ files).  video: draw video.mp4 too.

    frames: only so many from the beginning.  overwrite: replace an earlier output, once it is
    known that the scene can be set up.
    """

    format: str = "bag"
    video: bool = False
    frames: int | None = None
    overwrite: bool = False


@dataclass(frozen=True)
class RunResult:
    """frames: in the output.  resumed: how many of them were there before this run."""

    frames: int
    resumed: int


def run_scene(
    scene: Scene,
    output: Path,
    options: RunOptions | None = None,
    cache_dir: Path | None = None,
    progress: Progress | None = None,
) -> RunResult:
    """Simulate a scene into the folder `output`; goes on with an unfinished run of the same scene.

    progress: called with what is done and the fraction of it.  The same scene gives the same
    bytes, interrupted or not.
    Raises OutputError where the folder cannot be used, other SimulationErrors where the scene
    cannot be simulated; what was simulated until then can be read.
    """
    folder = OutputFolder.at(output)
    folder.check_apart(file for file in (scene.file, scene.indenter.file) if file is not None)
    with folder.locked():
        return _run(scene, folder, options or RunOptions(), cache_dir, progress or _silent)


def _run(
    scene: Scene,
    folder: OutputFolder,
    options: RunOptions,
    cache_dir: Path | None,
    progress: Progress,
) -> RunResult:
    count = min(options.frames or scene.frame_count, scene.frame_count)
    job = job_of(scene, count, options.format)
    folder.claim(job, overwrite=options.overwrite)
    simulation = Simulation(scene, cache_dir, progress)
    if options.overwrite:
        folder.clear()
    writer, after = _Target(folder, scene, options.format).open()
    try:
        folder.begin(job)
        write_scene(scene, folder.path)
        _write_frames(simulation, after, count, _Sink(writer, folder), progress)
    finally:
        writer.close()
    if options.video:
        video = folder.path / VIDEO_FILE
        write_video(video, writer.frames(), scene, lambda done: progress(VIDEO, done / count))
    folder.finish()
    return RunResult(count, 0 if after is None else after.frame + 1)


class _Target:
    """The writer of an output, and the state to go on from."""

    def __init__(self, folder: OutputFolder, scene: Scene, kind: str) -> None:
        self._folder = folder
        self._scene = scene
        self._kind = kind

    def open(self) -> tuple[FrameOutput, MechanicalState | None]:
        """A writer that holds the frames up to the state; none where it is from the beginning."""
        return self._open_images() if self._kind == "png" else self._open_bag()

    def _open_images(self) -> tuple[FrameOutput, MechanicalState | None]:
        path = self._folder.path
        path.mkdir(parents=True, exist_ok=True)
        writer = ImageWriter(path, self._scene.frame_count)
        if not self._folder.unfinished:
            return writer, None
        return writer, Checkpoints(self._folder.hidden).newest(writer.written() - 1)

    def _open_bag(self) -> tuple[FrameOutput, MechanicalState | None]:
        path, sensor = self._folder.path, self._scene.sensor
        if not self._folder.unfinished:
            if path.exists():
                path.rmdir()
            return RecordingWriter(path, sensor), None
        with self._folder.parked() as earlier:
            whole = _count_frames(earlier, sensor)
            after = Checkpoints(earlier / self._folder.hidden.name).newest(whole - 1)
            kept = 0 if after is None else after.frame + 1
            writer = RecordingWriter(path, sensor)
            if kept:
                for stamp_ns, frame in islice(recorded_frames(earlier, sensor), kept):
                    writer.append_recorded(stamp_ns, frame)
        return writer, after


def _count_frames(bag: Path, sensor: SensorDescription) -> int:
    try:
        return sum(1 for _ in recorded_frames(bag, sensor))
    except BagError:
        # It was stopped before anything had been written.
        return 0


class _Sink:
    """Writes frames, each with the state that the next one needs."""

    def __init__(self, writer: FrameOutput, folder: OutputFolder) -> None:
        self._writer = writer
        self._checkpoints = Checkpoints(folder.hidden)

    def write(self, frame: SimulatedFrame) -> None:
        self._writer.append(frame)
        self._checkpoints.save(frame.state)


def _write_frames(
    simulation: Simulation,
    after: MechanicalState | None,
    count: int,
    sink: _Sink,
    progress: Progress,
) -> None:
    """Write the frames after a state.

    Ctrl-C reaches the main thread alone: a frame that another writes is written whole.
    """
    done = 0 if after is None else after.frame + 1
    progress(SIMULATING, done / count)
    with (
        ThreadPoolExecutor(1, thread_name_prefix="writing") as pool,
        closing(simulation.frames(after)) as frames,
    ):
        writing: Future[None] | None = None
        for frame in islice(frames, count - done):
            if writing is not None:
                writing.result()
            writing = pool.submit(sink.write, frame)
            progress(SIMULATING, (frame.index + 1) / count)
        if writing is not None:
            writing.result()


def _silent(_text: str, _fraction: float) -> None:
    pass


# Recordings of packaged scenes, simulated when they are first asked for.

WAITING = "waiting for another process that makes the same recording"


def recording_of(
    scene_name: str, progress: Progress | None = None, cache_dir: Path | None = None
) -> Path:
    """The bag of a packaged scene ("grasp"), from the cache folder or simulated now.

    The folder has the scene's name; scene.yaml and sensor.yaml are in it.  An interrupted
    simulation goes on where it stopped; where another process makes the same one, this waits.
    progress: called with what is done and the fraction of it.
    Raises SceneError for an unknown name, other SimulationErrors as `run_scene`.
    """
    scene = load_scene(scene_name)
    job = job_of(scene, scene.frame_count, "bag")
    name = files.digest(json.dumps(job, sort_keys=True))[:16]
    place = (cache_dir or files.default_cache_dir()) / "recordings" / name
    folder = OutputFolder(place / scene.name)
    try:
        files.own_contents(place)
    except OSError as error:
        msg = f"{place}: {error}"
        raise OutputError(msg) from None
    if folder.finished:
        return folder.path
    with ExitStack() as stack:
        try:
            stack.enter_context(files.locked(place / ".lock", wait_s=0.0))
        except TimeoutError:
            if progress:
                progress(WAITING, 0.0)
            stack.enter_context(files.locked(place / ".lock"))
        if not folder.finished:
            try:
                run_scene(scene, folder.path, RunOptions(), cache_dir, progress)
            except OutputError:
                # What a full disk or a strange hand left there is no recording to go on with.
                run_scene(scene, folder.path, RunOptions(overwrite=True), cache_dir, progress)
    return folder.path


# The mechanical states of an unfinished run, kept so that it can go on where it stopped.

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
        with files.atomic_path(self._path(state.frame)) as beside, beside.open("wb") as file:
            np.savez(file, allow_pickle=False, **_arrays(state))
        self._path(state.frame - KEPT).unlink(missing_ok=True)

    def newest(self, frame: int) -> MechanicalState | None:
        """The newest state that can be read of those up to a frame."""
        for path in self._files(frame):
            state = _read(path)
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


def _read(path: Path) -> MechanicalState | None:
    """The state of a file; None, with a line in the log, where it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return _state({name: file[name] for name in file.files})
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        LOGGER.warning("%s: cannot be used, an earlier one is: %s", path, error)
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
