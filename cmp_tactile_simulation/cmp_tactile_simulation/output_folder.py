"""The folder that a run writes: whose it is, whether it is finished, and how it is taken up again.

While a run is unfinished, its folder holds `.unfinished`: what is simulated (job.json), the
newest mechanical states.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.file_lock import FileLock
from cmp_tactile_simulation.scene import Scene
from cmp_tactile_simulation.scene_writer import SCENE_FILE, scene_mapping
from cmp_tactile_simulation.simulation import SIMULATOR_VERSION

__all__ = ["OutputFolder", "job_of"]

UNFINISHED = ".unfinished"
JOB_FILE = "job.json"
# All that a run writes, but for the indenter's mesh; nothing else is ever deleted.
OURS = re.compile(
    r"\.unfinished|(scene|sensor|metadata)\.yaml(\.tmp)?|[^/]+\.mcap|(\.partial\.)?video\.mp4"
    r"|\d{3,}\.(png|npz)|\.[^/]+\.partial"
)

Job = dict[str, Any]


def job_of(scene: Scene, frames: int, kind: str) -> Job:
    """All that the bytes of an output depend on.  kind: bag or png."""
    mesh = scene.indenter.file
    job = {
        "simulator": SIMULATOR_VERSION,
        "format": kind,
        "frames": frames,
        "scene": scene_mapping(scene),
        "sensor": dict(scene.sensor_mapping),
        "mesh": hashlib.sha256(mesh.read_bytes()).hexdigest() if mesh else "",
    }
    # As it is read back: lists for tuples.
    return dict(json.loads(json.dumps(job)))


class OutputFolder:
    """One output folder, at `path`."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def hidden(self) -> Path:
        """What only an unfinished run has."""
        return self.path / UNFINISHED

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes away; OutputError where one of them is at work here."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(self.path.with_name(f".{self.path.name}.lock")) as lock:
            if not lock.acquire(wait=False):
                msg = f"{self.path}: is being written by another process"
                raise OutputError(msg)
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

        overwrite: an earlier output is deleted.  Raises OutputError, and leaves all as it is,
        where the folder holds something else, a finished output or another unfinished job.
        """
        self._recover()
        if not self.path.exists() or (self.path.is_dir() and not any(self.path.iterdir())):
            return
        stranger = self._stranger()
        if stranger or not (self.finished or self.unfinished):
            found = stranger or "no scene.yaml"
            msg = f"{self.path}: found {found}, expected a simulated recording or nothing"
            raise OutputError(msg)
        if overwrite:
            shutil.rmtree(self.path)
        elif self.finished:
            msg = f"{self.path}: exists already; --overwrite replaces it"
            raise OutputError(msg)
        else:
            self._compare(job)

    def begin(self, job: Job) -> None:
        """Mark the folder, which exists, as this unfinished job's."""
        self.hidden.mkdir(exist_ok=True)
        partial = self.hidden / f".{JOB_FILE}.partial"
        partial.write_text(json.dumps(job), encoding="utf-8")
        partial.replace(self.hidden / JOB_FILE)

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

    def _stranger(self) -> str:
        """Name of something here that no run wrote, empty where there is none."""
        if not self.path.is_dir():
            return "a file"
        names = sorted(item.name for item in self.path.iterdir())
        mesh = self._mesh()
        return next((name for name in names if name != mesh and not OURS.fullmatch(name)), "")

    def _mesh(self) -> str:
        try:
            content = yaml.safe_load((self.path / SCENE_FILE).read_text(encoding="utf-8"))
            return str(content["indenter"]["file"])
        except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError):
            return ""

    @property
    def _parked(self) -> Path:
        return self.path.with_name(f".{self.path.name}.interrupted")

    def _recover(self) -> None:
        """Put right what was left by a process that died while it copied a parked output."""
        if (self._parked / UNFINISHED).exists():
            if self.path.exists():
                shutil.rmtree(self.path)
            self._parked.rename(self.path)
        elif self._parked.exists():
            shutil.rmtree(self._parked)

    def _compare(self, job: Job) -> None:
        try:
            earlier = json.loads((self.hidden / JOB_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            msg = f"{self.path}: unfinished, cannot be taken up: {error}; --overwrite starts anew"
            raise OutputError(msg) from None
        difference = _first_difference(earlier, job)
        if difference:
            msg = f"{self.path}: is an unfinished run with {difference}; --overwrite starts anew"
            raise OutputError(msg)


def _first_difference(found: Any, asked: Any, path: str = "") -> str:
    """The first key whose values differ, in words; empty where none does."""
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
