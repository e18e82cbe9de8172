"""Runs a scene into files, and goes on where an interrupted run stopped."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from cmp_tactile_driver.errors import BagError
from cmp_tactile_processing.elastic.problem import Progress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.recording.checkpoint import Checkpoints
from cmp_tactile_simulation.recording.frame_output import FrameOutput
from cmp_tactile_simulation.recording.image_writer import ImageWriter
from cmp_tactile_simulation.recording.output_folder import OutputFolder, job_of
from cmp_tactile_simulation.recording.reader import recorded_frames
from cmp_tactile_simulation.recording.video_writer import write_video
from cmp_tactile_simulation.recording.writer import RecordingWriter
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.simulation import MechanicalState, SimulatedFrame, Simulation
from cmp_tactile_simulation.scenes.writer import write_scene

__all__ = ["FORMATS", "RunOptions", "RunResult", "run_scene"]

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
    tell: Progress,
) -> RunResult:
    count = min(options.frames or scene.frame_count, scene.frame_count)
    job = job_of(scene, count, options.format)
    folder.claim(job, overwrite=options.overwrite)
    simulation = Simulation(scene, cache_dir, tell)
    if options.overwrite:
        folder.clear()
    writer, after = _Target(folder, scene, options.format).open()
    try:
        folder.begin(job)
        write_scene(scene, folder.path)
        _write_frames(simulation, after, count, _Sink(writer, folder), tell)
    finally:
        writer.close()
    if options.video:
        video = folder.path / VIDEO_FILE
        write_video(video, writer.frames(), scene, lambda done: tell(VIDEO, done / count))
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
    tell: Progress,
) -> None:
    """Write the frames after a state.

    Ctrl-C reaches the main thread alone: a frame that another writes is written whole.
    """
    done = 0 if after is None else after.frame + 1
    tell(SIMULATING, done / count)
    with (
        ThreadPoolExecutor(1, thread_name_prefix="writing") as pool,
        closing(simulation.frames(after)) as frames,
    ):
        writing: Future[None] | None = None
        for frame in islice(frames, count - done):
            if writing is not None:
                writing.result()
            writing = pool.submit(sink.write, frame)
            tell(SIMULATING, (frame.index + 1) / count)
        if writing is not None:
            writing.result()


def _silent(_text: str, _fraction: float) -> None:
    pass
