"""Runs a scene into files, and goes on where an interrupted run stopped."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

from cmp_tactile_processing.cache import files
from cmp_tactile_processing.cache.compiled import source_digest
from cmp_tactile_processing.elastic.model import Progress
from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.recording.checkpoints import Checkpoints
from cmp_tactile_simulation.recording.output_folder import Job, OutputFolder
from cmp_tactile_simulation.recording.truth import count_frames
from cmp_tactile_simulation.recording.video import write_video
from cmp_tactile_simulation.recording.writer import FrameOutput, ImageWriter, RecordingWriter
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import load_scene, scene_mapping, write_scene
from cmp_tactile_simulation.scenes.simulation import MechanicalState, SimulatedFrame, Simulation

FORMATS = ("bag", "png")
PACKAGES = ("cmp_tactile_simulation", "cmp_tactile_processing")
SIMULATING = "simulating"
VIDEO = "drawing the video"
VIDEO_FILE = "video.mp4"
WAITING = "waiting for another process, which makes the same recording"


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
    folder.begin(job)
    checkpoints = Checkpoints(folder.hidden)
    writer, after = _opened(folder, scene, options.format, checkpoints)

    def write(frame: SimulatedFrame) -> None:
        writer.append(frame)
        checkpoints.save(frame.state)

    try:
        write_scene(scene, folder.path)
        _write_frames(simulation, after, count, write, progress)
    except OSError as error:
        # An open file does not say which it is.
        error.filename = error.filename or str(folder.path)
        raise
    finally:
        writer.close()
    if options.video:
        video = folder.path / VIDEO_FILE
        write_video(video, writer.frames(), scene, lambda done: progress(VIDEO, done / count))
    folder.finish()
    return RunResult(count, 0 if after is None else after.frame + 1)


def _opened(
    folder: OutputFolder, scene: Scene, kind: str, checkpoints: Checkpoints
) -> tuple[FrameOutput, MechanicalState | None]:
    """A writer, and the state after the frames that it has already; None from the beginning."""
    if kind == "png":
        images = ImageWriter(folder.path, scene.frame_count)
        return images, checkpoints.newest(images.written() - 1)
    after = checkpoints.newest(count_frames(folder.path, scene.sensor) - 1)
    kept = 0 if after is None else after.frame + 1
    return RecordingWriter(folder.path, scene.sensor, kept), after


def _write_frames(
    simulation: Simulation,
    after: MechanicalState | None,
    count: int,
    write: Callable[[SimulatedFrame], None],
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
            writing = pool.submit(write, frame)
            progress(SIMULATING, (frame.index + 1) / count)
        if writing is not None:
            writing.result()


def _silent(_text: str, _fraction: float) -> None:
    pass


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


def job_of(scene: Scene, frames: int, kind: str) -> Job:
    """All that the bytes of an output depend on.  kind: bag or png."""
    mesh = scene.indenter.file
    job = {
        "simulator": simulator_version(),
        "format": kind,
        "frames": frames,
        "scene": scene_mapping(scene),
        "sensor": dict(scene.sensor_mapping),
        "mesh": files.digest(mesh.read_bytes()) if mesh else "",
    }
    # As it is read back: lists for tuples.
    return dict(json.loads(json.dumps(job)))


@lru_cache(maxsize=1)
def simulator_version() -> str:
    """Changes with all that the frames of a scene are computed with, but for the libraries."""
    return "-".join(source_digest(_folder(name)) for name in PACKAGES)


def _folder(package: str) -> Path:
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        msg = f"{package}: found no folder of its sources, expected an installed package"
        raise ModuleNotFoundError(msg)
    return Path(spec.origin).parent
