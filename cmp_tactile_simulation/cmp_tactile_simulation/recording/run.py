"""Runs a scene into files, and goes on where an interrupted run stopped.

A folder that a run writes holds `.cmp_tactile_recording`, without which nothing is deleted.  While
the run is unfinished, it holds `.unfinished`: what is simulated (job.json), the newest mechanical
states.
"""

from __future__ import annotations

import json
import logging
import re
import shutil
import zipfile
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.errors import BagError
from cmp_tactile_processing.cache import files
from cmp_tactile_processing.cache.compiled import source_digest
from cmp_tactile_processing.cache.files import atomic_path, digest, locked
from cmp_tactile_processing.elastic.model import Progress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose
from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.recording.truth import FrameOutput, recorded_frames
from cmp_tactile_simulation.recording.writer import ImageWriter, RecordingWriter, write_video
from cmp_tactile_simulation.scenes.description import PhaseStart, Scene
from cmp_tactile_simulation.scenes.file import SCENE_FILE, load_scene, scene_mapping, write_scene
from cmp_tactile_simulation.scenes.simulation import MechanicalState, SimulatedFrame, Simulation

MARKER = ".cmp_tactile_recording"
UNFINISHED = ".unfinished"
JOB_FILE = "job.json"
# All that a run writes, but for the indenter's mesh; nothing else is ever deleted.
OURS = re.compile(
    r"\.cmp_tactile_recording|\.unfinished|(scene|sensor|metadata)\.yaml(\.tmp)?|[^/]+\.mcap|(\.partial\.)?video\.mp4"
    r"|\d{3,}\.(png|npz)|\.[^/]+\.partial"
)
# All that is there while the frames of a parked output are copied.
COPY = re.compile(r"[^/]+\.mcap")
Job = dict[str, Any]


def job_of(scene: Scene, frames: int, kind: str) -> Job:
    """All that the bytes of an output depend on.  kind: bag or png."""
    mesh = scene.indenter.file
    job = {
        "simulator": simulator_version(),
        "format": kind,
        "frames": frames,
        "scene": scene_mapping(scene),
        "sensor": dict(scene.sensor_mapping),
        "mesh": digest(mesh.read_bytes()) if mesh else "",
    }
    # As it is read back: lists for tuples.
    return dict(json.loads(json.dumps(job)))


class OutputFolder:
    """One output folder, at `path`."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def at(cls, path: Path) -> OutputFolder:
        """The folder that a path, relative or a link, leads to; OutputError where none can be."""
        try:
            whole, working = path.resolve(), Path.cwd()
        except (OSError, RuntimeError) as error:
            msg = f"{path}: cannot be an output folder: {error}"
            raise OutputError(msg) from None
        if whole == working or whole in working.parents:
            # It is replaced as a whole, and what is relative to it would be lost.
            msg = f"{path}: is or holds the working folder; --output names another one"
            raise OutputError(msg)
        if not whole.name:
            msg = f"{path}: is the root of all folders; --output names another one"
            raise OutputError(msg)
        return cls(whole)

    def check_apart(self, files: Iterable[Path]) -> None:
        """OutputError where one of the files that the run reads is in this folder."""
        for file in files:
            places = (file.parent.resolve() / file.name, file.resolve())
            if any(self.path in place.parents for place in places):
                msg = f"{self.path}: holds {file}, which is read; --output names another folder"
                raise OutputError(msg)

    @property
    def hidden(self) -> Path:
        """What only an unfinished run has."""
        return self.path / UNFINISHED

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes away; OutputError where one of them is at work here."""
        with ExitStack() as stack:
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                lock = self.path.with_name(f".{self.path.name}.lock")
                stack.enter_context(locked(lock, wait_s=0.0))
            except TimeoutError:
                msg = f"{self.path}: is being written by another process"
                raise OutputError(msg) from None
            except OSError as error:
                msg = f"{self.path}: cannot be an output folder: {error}"
                raise OutputError(msg) from None
            yield

    @property
    def finished(self) -> bool:
        """Whether a run was completed here."""
        whole = (self.path / SCENE_FILE).is_file() and not self.hidden.exists()
        return whole and not self._parked.exists()

    @property
    def unfinished(self) -> bool:
        """Whether a run was begun here and not completed."""
        return self.hidden.exists() or (self._parked / UNFINISHED).exists()

    def claim(self, job: Job, *, overwrite: bool) -> None:
        """Make sure that this job may be written here, from the beginning or going on.

        overwrite: an earlier output may be there, to be deleted by `clear`.  Raises OutputError,
        and leaves all as it is, where the folder holds something else, a finished output or
        another unfinished job.
        """
        self._recover()
        if self._check_ours() or overwrite:
            return
        if self.finished:
            msg = f"{self.path}: exists already; --overwrite replaces it"
            raise OutputError(msg)
        self._compare(job)

    def clear(self) -> None:
        """Delete an earlier output; OutputError where something else has come into it."""
        if self._check_ours():
            return
        # What says which run it belongs to goes last, should this be stopped.
        (self.path / SCENE_FILE).unlink(missing_ok=True)
        for item in self.path.iterdir():
            if item.name != MARKER:
                shutil.rmtree(item) if item.is_dir() else item.unlink()
        shutil.rmtree(self.path)

    def begin(self, job: Job) -> None:
        """Mark the folder, which exists, as this unfinished job's."""
        with atomic_path(self.path / MARKER) as beside:
            beside.write_text(json.dumps({"mesh": _mesh_name(job)}) + "\n", encoding="utf-8")
        self.hidden.mkdir(exist_ok=True)
        with atomic_path(self.hidden / JOB_FILE) as beside:
            beside.write_text(json.dumps(job), encoding="utf-8")

    def finish(self) -> None:
        """Nothing is left to do: from now on the output is finished."""
        shutil.rmtree(self.hidden)

    @contextmanager
    def parked(self) -> Iterator[Path]:
        """The unfinished output under another name, so that it can be copied into a new one.

        Afterwards the new folder holds `.unfinished`; an error brings the old one back.
        """
        self.path.rename(self._parked)
        try:
            yield self._parked
            (self._parked / UNFINISHED).rename(self.hidden)
        except BaseException:
            self._recover()
            raise
        shutil.rmtree(self._parked)

    def _check_ours(self) -> bool:
        """Whether nothing is here; OutputError where there is something that no run wrote."""
        if not self.path.exists() or (self.path.is_dir() and not any(self.path.iterdir())):
            return True
        found = _stranger(self.path, OURS, _meshes(self.path))
        marks = (self.path / MARKER, self.hidden / JOB_FILE)
        if not found and not any(mark.is_file() for mark in marks):
            found = f"no {MARKER}"
        if found:
            msg = f"{self.path}: found {found}, expected a simulated recording or nothing"
            raise OutputError(msg)
        return False

    @property
    def _parked(self) -> Path:
        return self.path.with_name(f".{self.path.name}.interrupted")

    def _recover(self) -> None:
        """Put right what was left by a process that died while it copied a parked output."""
        parked = self._parked
        if not parked.exists():
            return
        copying = (parked / UNFINISHED).exists()
        found = _stranger(parked, OURS, _meshes(parked) | _meshes(self.path))
        if found:
            msg = f"{parked}: found {found}, expected an interrupted run's recording or nothing"
            raise OutputError(msg)
        if copying and self.path.exists():
            found = _stranger(self.path, COPY)
            if found:
                msg = f"{self.path}: found {found}, expected nothing: {parked} takes its place"
                raise OutputError(msg)
            shutil.rmtree(self.path)
        if copying:
            parked.rename(self.path)
        else:
            shutil.rmtree(parked)

    def _compare(self, job: Job) -> None:
        try:
            earlier = json.loads((self.hidden / JOB_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            msg = f"{self.path}: unfinished, cannot be taken up: {error}; --overwrite starts again"
            raise OutputError(msg) from None
        difference = _first_difference(earlier, job)
        if difference:
            msg = f"{self.path}: is an unfinished run with {difference}; --overwrite starts again"
            raise OutputError(msg)


def _stranger(folder: Path, known: re.Pattern[str], meshes: frozenset[str] = frozenset()) -> str:
    """Name of something there that is neither known nor a mesh, empty where there is none."""
    if not folder.is_dir():
        return "a file"
    names = sorted(item.name for item in folder.iterdir())
    return next((name for name in names if name not in meshes and not known.fullmatch(name)), "")


def _meshes(folder: Path) -> frozenset[str]:
    """Names that an indenter's mesh may have there, as the runs that wrote it left word."""
    marker, job = _read(folder / MARKER), _read(folder / UNFINISHED / JOB_FILE)
    return frozenset({str(marker.get("mesh", "")), _mesh_name(job)} - {""})


def _mesh_name(job: Job) -> str:
    try:
        return str(job["scene"]["indenter"].get("file", ""))
    except (AttributeError, KeyError, TypeError):
        return ""


def _read(path: Path) -> dict[str, Any]:
    """A JSON file's mapping, empty where there is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _first_difference(found: Any, asked: Any, path: str = "") -> str:
    """The first key with different values, in words; empty where none does."""
    if isinstance(found, dict) and isinstance(asked, dict):
        for key in [*found, *(key for key in asked if key not in found)]:
            where = f"{path}.{key}".lstrip(".")
            text = _first_difference(found.get(key), asked.get(key), where)
            if text:
                return text
        return ""
    return "" if found == asked else f"{path} {_short(found)}, not {_short(asked)}"


def _short(value: Any, length: int = 60) -> str:
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) <= length else text[: length - 3] + "..."


# The version of the sources that are at work, from their content.

PACKAGES = ("cmp_tactile_simulation", "cmp_tactile_processing")


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
