"""Runs a scene into a folder: a recording, and pictures of it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

from cmp_tactile_processing.cache import files
from cmp_tactile_processing.cache.compiled import source_digest
from cmp_tactile_processing.errors import OutputError
from cmp_tactile_processing.processes import OnProgress, no_progress
from cmp_tactile_simulation.recording.pictures import write_images, write_video
from cmp_tactile_simulation.recording.truth import RecordingWriter, recorded_frames
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import (
    SCENE_FILE,
    load_scene,
    scene_mapping,
    write_scene,
)
from cmp_tactile_simulation.scenes.simulation import Simulation
from cmp_tactile_simulation.simulator import SimulatedFrame

PACKAGES = ("cmp_tactile_simulation", "cmp_tactile_processing")
SIMULATING = "simulating"
VIDEO, IMAGES = "drawing the video", "writing the images"
VIDEO_FILE = "video.mp4"
WAITING = "waiting for another process, which makes the same recording"
# A folder without it is no output, and nothing in it is deleted.  It contains the name of the mesh.
MARKER = ".cmp_tactile_recording"
# Is there until the output is complete.
UNFINISHED = ".unfinished"
# What a run writes, in addition to these two and the indenter's mesh; nothing else is ever deleted.
OURS = re.compile(
    r"(scene|sensor|metadata)\.yaml|[^/]+\.mcap|(\.partial\.)?video\.mp4|\d{3,}\.(png|npz)"
)


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


def run_scene(
    scene: Scene,
    output: Path,
    options: RunOptions | None = None,
    cache_dir: Path | None = None,
    progress: OnProgress | None = None,
) -> int:
    """Simulate a scene into the folder `output`; returns the number of frames.

    An unfinished output is replaced, a finished one only where the options say so.
    progress: called with what is done and the fraction of it.  The same scene gives the same
    bytes.
    Raises OutputError where the folder cannot be used, other errors where the scene
    cannot be simulated; what was simulated until then can be read.
    """
    options, progress = options or RunOptions(), progress or no_progress
    folder = _usable(output)
    _check_apart(folder, (file for file in (scene.file, scene.indenter.file) if file is not None))
    with _locked(folder):
        _check_replaceable(folder, overwrite=options.overwrite)
        simulation = Simulation(scene, cache_dir, progress)
        _begin(folder, scene)
        count = min(options.frames or scene.frame_count, scene.frame_count)
        _record(simulation, folder, count, progress)
        _write_pictures(scene, folder, options, progress)
        (folder / UNFINISHED).unlink()
    return count


def _record(simulation: Simulation, folder: Path, count: int, progress: OnProgress) -> None:
    """Write scene, sensor description and the bag of so many frames."""
    scene = simulation.scene
    write_scene(scene, folder)
    writer = RecordingWriter(folder, scene.sensor)
    try:
        _write_frames(simulation, count, writer.append, progress)
    except OSError as error:
        # An open file does not say which it is.
        error.filename = error.filename or str(folder)
        raise
    finally:
        writer.close()


def _write_frames(
    simulation: Simulation,
    count: int,
    write: Callable[[SimulatedFrame], None],
    progress: OnProgress,
) -> None:
    """Write the frames.

    Ctrl-C reaches the main thread alone: a frame that another writes is written whole.
    """
    progress(SIMULATING, 0.0)
    with (
        ThreadPoolExecutor(1, thread_name_prefix="writing") as pool,
        closing(simulation.frames()) as frames,
    ):
        writing: Future[None] | None = None
        for frame in islice(frames, count):
            if writing is not None:
                writing.result()
            writing = pool.submit(write, frame)
            progress(SIMULATING, (frame.index + 1) / count)
        if writing is not None:
            writing.result()


def _write_pictures(scene: Scene, folder: Path, options: RunOptions, progress: OnProgress) -> None:
    """Make of the bag what else is wanted; images take its place."""
    count = min(options.frames or scene.frame_count, scene.frame_count)
    if options.video:
        frames = recorded_frames(folder, scene.sensor)
        write_video(folder / VIDEO_FILE, frames, scene, lambda done: progress(VIDEO, done / count))
    if options.format == "png":
        frames = recorded_frames(folder, scene.sensor)
        done = write_images(
            folder, frames, scene.frame_count, lambda done: progress(IMAGES, done / count)
        )
        if done != count:
            msg = f"{folder}: found {done} whole frames in the bag, expected {count}; it is kept"
            raise OutputError(msg)
        for name in (f"{folder.name}.mcap", "metadata.yaml"):
            (folder / name).unlink()


def _usable(path: Path) -> Path:
    """The folder that a path, relative or a link, leads to; OutputError where none can be."""
    try:
        folder, working = path.resolve(), Path.cwd()
    except (OSError, RuntimeError) as error:
        msg = f"{path}: cannot be an output folder: {error}"
        raise OutputError(msg) from None
    if folder == working or folder in working.parents:
        # Files of a recording are not to be mixed with others of the working folder.
        msg = f"{path}: is or contains the working folder; give another one with --output"
        raise OutputError(msg)
    return folder


def _check_apart(folder: Path, inputs: Iterable[Path]) -> None:
    """OutputError where one of the files that the run reads is in the folder."""
    for file in inputs:
        if (
            folder in (file.parent.resolve() / file.name).parents
            or folder in file.resolve().parents
        ):
            msg = f"{folder}: contains the input {file}; give another folder with --output"
            raise OutputError(msg)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other processes away; OutputError where one of them is at work here."""
    with ExitStack() as stack:
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            lock = folder.with_name(f".{folder.name}.lock")
            stack.enter_context(files.locked(lock, wait_s=0.0))
        except TimeoutError:
            msg = f"{folder}: is being written by another process"
            raise OutputError(msg) from None
        except OSError as error:
            msg = f"{folder}: cannot be an output folder: {error}"
            raise OutputError(msg) from None
        yield


def _is_finished(folder: Path) -> bool:
    return (folder / SCENE_FILE).is_file() and not (folder / UNFINISHED).exists()


def _check_replaceable(folder: Path, *, overwrite: bool) -> None:
    """OutputError where the folder holds something else, or a finished output that is to stay."""
    is_folder = folder.is_dir()
    if not folder.exists() or (is_folder and not any(folder.iterdir())):
        return
    if not (folder / MARKER).is_file():
        found = f"no {MARKER}" if is_folder else "a file"
        msg = f"{folder}: found {found}, expected a simulated recording or an empty folder"
        raise OutputError(msg)
    if _is_finished(folder):
        files.check_free([folder], overwrite=overwrite)


def _begin(folder: Path, scene: Scene) -> None:
    """Make the folder an unfinished output without what an earlier run wrote; other files stay."""
    folder.mkdir(exist_ok=True)
    marker = folder / MARKER
    marker.touch()
    # Before anything is deleted: the folder is not taken for a finished output if this is killed.
    (folder / UNFINISHED).touch()
    mesh = marker.read_text(encoding="utf-8", errors="replace")
    for item in sorted(folder.iterdir()):
        if item.is_file() and (OURS.fullmatch(item.name) or item.name == mesh):
            item.unlink()
    mesh_file = scene.indenter.file
    marker.write_text(mesh_file.name if mesh_file else "", encoding="utf-8")


def recording_of(
    scene_name: str, progress: OnProgress | None = None, cache_dir: Path | None = None
) -> Path:
    """The bag of a packaged scene ("grasp"), from the cache folder or simulated now.

    The folder has the scene's name; scene.yaml and sensor.yaml are in it.  Where another process
    makes the same one, this waits.
    progress: called with what is done and the fraction of it.
    Raises InputError for an unknown name, other SimulationErrors as `run_scene`.
    """
    scene = load_scene(scene_name)
    place = (cache_dir or files.default_cache_dir()) / "recordings" / _key(scene)
    folder = place / scene.name
    try:
        files.own_folder(place)
    except OSError as error:
        msg = f"{place}: {error}"
        raise OutputError(msg) from None
    if _is_finished(folder):
        return folder
    with ExitStack() as stack:
        try:
            stack.enter_context(files.locked(place / ".lock", wait_s=0.0))
        except TimeoutError:
            if progress:
                progress(WAITING, 0.0)
            stack.enter_context(files.locked(place / ".lock"))
        if not _is_finished(folder):
            run_scene(scene, folder, cache_dir=cache_dir, progress=progress)
    return folder


def _key(scene: Scene) -> str:
    """Digest of all that the bytes of a recording depend on."""
    mesh = scene.indenter.file
    sources = {
        "simulator": simulator_version(),
        "scene": scene_mapping(scene),
        "sensor": dict(scene.sensor_mapping),
        "mesh": files.digest(mesh.read_bytes()) if mesh else "",
    }
    return files.digest(json.dumps(sources, sort_keys=True))[:16]


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
