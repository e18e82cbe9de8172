"""The folder that a run writes: whether it may, and what an earlier run left there.

The folder holds `.cmp_tactile_recording`, without which nothing is deleted.  While the run is
unfinished, it holds `.unfinished`: what is simulated (job.json), the newest mechanical states.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from cmp_tactile_processing.cache.files import atomic_path, locked
from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.scenes.file import SCENE_FILE

MARKER = ".cmp_tactile_recording"
UNFINISHED = ".unfinished"
JOB_FILE = "job.json"
# All that a run writes, but for the indenter's mesh; nothing else is ever deleted.
OURS = re.compile(
    r"\.cmp_tactile_recording|\.unfinished|(scene|sensor|metadata)\.yaml|[^/]+\.mcap|(\.partial\.)?video\.mp4"
    r"|\d{3,}\.(png|npz)|\.[^/]+\.partial"
)
SHOWN_CHARACTERS = 60
Job = dict[str, Any]
"""All that the bytes of an output depend on."""


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
            # Files of a recording are not to be mixed with others of the working folder.
            msg = f"{path}: is or contains the working folder; give another one with --output"
            raise OutputError(msg)
        if not whole.name:
            msg = f"{path}: is the root folder; give another one with --output"
            raise OutputError(msg)
        return cls(whole)

    def check_apart(self, files: Iterable[Path]) -> None:
        """OutputError where one of the files that the run reads is in this folder."""
        for file in files:
            places = (file.parent.resolve() / file.name, file.resolve())
            if any(self.path in place.parents for place in places):
                msg = f"{self.path}: contains the input {file}; give another folder with --output"
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
        return (self.path / SCENE_FILE).is_file() and not self.hidden.exists()

    def claim(self, job: Job, *, overwrite: bool) -> None:
        """Make sure that this job may be written here, from the beginning or going on.

        overwrite: an earlier output may be there, to be deleted by `clear`.  Raises OutputError,
        and leaves all as it is, where the folder holds something else, a finished output or
        another unfinished job.
        """
        is_folder = self.path.is_dir()
        if not self.path.exists() or (is_folder and not any(self.path.iterdir())):
            return
        if not (self.path / MARKER).is_file():
            found = f"no {MARKER}" if is_folder else "a file"
            msg = f"{self.path}: found {found}, expected a simulated recording or an empty folder"
            raise OutputError(msg)
        if overwrite:
            return
        if self.finished:
            msg = f"{self.path}: exists already; --overwrite replaces it"
            raise OutputError(msg)
        self._compare(job)

    def clear(self) -> None:
        """Delete what an earlier run wrote; other files stay."""
        if not self.path.exists():
            return
        mesh = _read(self.path / MARKER).get("mesh")
        # What says that a run wrote it goes last, should this be stopped.
        for item in sorted(self.path.iterdir(), key=lambda item: item.name == MARKER):
            if item.name == mesh or OURS.fullmatch(item.name):
                shutil.rmtree(item) if item.is_dir() else item.unlink()

    def begin(self, job: Job) -> None:
        """Make the folder where it is not there, and mark it as this unfinished job's."""
        self.hidden.mkdir(parents=True, exist_ok=True)
        mesh = job["scene"]["indenter"].get("file", "")
        for path, content in (
            (self.path / MARKER, {"mesh": mesh}),
            (self.hidden / JOB_FILE, job),
        ):
            with atomic_path(path) as beside:
                beside.write_text(json.dumps(content) + "\n", encoding="utf-8")

    def finish(self) -> None:
        """Nothing is left to do: from now on the output is finished."""
        shutil.rmtree(self.hidden)

    def _compare(self, job: Job) -> None:
        difference = _first_difference(_read(self.hidden / JOB_FILE), job)
        if difference:
            msg = f"{self.path}: is an unfinished run with {difference}; --overwrite starts again"
            raise OutputError(msg)


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


def _short(value: Any) -> str:
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."
