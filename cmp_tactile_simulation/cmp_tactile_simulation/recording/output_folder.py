"""The folder that a run writes: which run it belongs to, whether it is finished, how it is resumed.

Each holds `.cmp_tactile_recording`, without which nothing is deleted.  While a run is unfinished,
its folder holds `.unfinished`: what is simulated (job.json), the newest mechanical states.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cmp_tactile_processing.cache.compiled import source_digest
from cmp_tactile_processing.cache.files import atomic_path, digest, locked
from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import SCENE_FILE, scene_mapping

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
