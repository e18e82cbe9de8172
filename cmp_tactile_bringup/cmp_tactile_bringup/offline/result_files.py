"""Files of results that are there whole or not at all, whatever ends the process that makes them.

All are written in a hidden folder beside their places.  Its record, which comes last, says that
they are complete; then they are moved, and the record after them.  What is found of an interrupted
run is removed, or moved to its place where the record is there.

The record names what the results were made from: recording, sensor description, software, options.
The same means the same bytes of results, however they are made, on processors of one type.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_bringup.offline.jobs import Job, Options, Outcome
from cmp_tactile_processing.cache.compiled import source_digest
from cmp_tactile_processing.cache.files import atomic_path, digest, files_digest, locked

__all__ = ["RECORD", "ResultFiles", "software_version"]

RECORD = "_process.json"
VERSION = 1
# The lock of a run that was just killed is gone in a moment.
SECONDS_FOR_LOCK = 3.0
OPTIONAL = (".npz", "_wrench.parquet")
# The results depend on the sources of these packages, and contain what these libraries make.
PACKAGES = ("cmp_tactile_processing", "cmp_tactile_driver", "cmp_tactile_simulation")
LIBRARIES = ("numpy", "scipy", "numba", "mcap", "rosbags", "pyarrow")
WORDS = {
    "recording": "another recording",
    "sensor": "another sensor description",
    "software": "another version of the software",
    "options": "other options",
}


class ResultFiles:
    """The results of one job.  A context manager: within it, no other process makes the same.

    Raises OutputError on entry where another process does, and OSError for a folder that cannot be
    written.
    """

    def __init__(self, job: Job, options: Options) -> None:
        self._job = job
        self._options = options
        self._partial = job.path("").with_name(f".{job.name}.partial")
        self._lock = ExitStack()
        self._identity: dict[str, Any] | None = None
        self._state: list[list[str | int]] = []
        self._left_over: set[str] = set()

    def __enter__(self) -> ResultFiles:
        Path(self._job.folder).mkdir(parents=True, exist_ok=True)
        lock = locked(self._job.path("").with_name(f".{self._job.name}.lock"), SECONDS_FOR_LOCK)
        with ExitStack() as stack:
            try:
                stack.enter_context(lock)
            except TimeoutError:
                msg = f"{self._job.path('')}: another process is at work on these results"
                raise OutputError(msg) from None
            if (self._partial / RECORD).exists():
                self._move()
            self._remove_partial()
            self._lock = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        with self._lock:
            # Complete files that could not all be moved are moved the next time.
            if not (self._partial / RECORD).exists():
                self._remove_partial()

    def finished(self, *, overwrite: bool) -> Outcome | None:
        """What came of the job in an earlier run, where that made all its files from the same.

        Raises OutputError where there are files of something else, and overwrite does not allow to
        replace them.
        """
        record = self._read_record()
        reason = "made from something unknown"
        if record is not None:
            self._left_over = set(record["files"]) - set(self._options.suffixes)
            reason = self._mismatch(record)
            if not reason:
                return Outcome.from_record(record["outcome"])
        if not overwrite:
            for path in map(self._job.path, (*self._options.suffixes, RECORD)):
                if path.exists():
                    msg = f"{path}: exists already, {reason}; --overwrite replaces it"
                    raise OutputError(msg)
        return None

    def begin(self) -> Path:
        """An empty folder for the files, each to be named by its suffix alone."""
        # As they are now: should the recording change meanwhile, the next run is to see it.
        self._current_identity()
        self._partial.mkdir()
        return self._partial

    def complete(self, outcome: Outcome) -> None:
        """Move the files to their places."""
        for suffix in self._options.suffixes:
            _make_durable(self._partial / suffix)
        record = {
            "version": VERSION,
            "identity": self._current_identity(),
            "recording_state": self._state,
            "outcome": outcome.as_record(),
            "files": {s: (self._partial / s).stat().st_size for s in self._options.suffixes},
        }
        with atomic_path(self._partial / RECORD) as beside:
            beside.write_text(json.dumps(record, indent=1), encoding="utf-8")
        _make_durable(self._partial)
        self._move()
        for suffix in self._left_over & set(OPTIONAL):
            self._job.path(suffix).unlink(missing_ok=True)

    def _move(self) -> None:
        for path in sorted(self._partial.iterdir()):
            if path.name != RECORD:
                path.replace(self._job.path(path.name))
        (self._partial / RECORD).replace(self._job.path(RECORD))

    def _remove_partial(self) -> None:
        if self._partial.exists():
            shutil.rmtree(self._partial)

    def _read_record(self) -> Mapping[str, Any] | None:
        try:
            record = json.loads(self._job.path(RECORD).read_text(encoding="utf-8"))
            if record["version"] != VERSION:
                return None
            Outcome.from_record(record["outcome"])
            dict(record["identity"]), dict(record["files"]), list(record["recording_state"])
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return dict(record)

    def _mismatch(self, record: Mapping[str, Any]) -> str:
        for suffix, size in record["files"].items():
            path = self._job.path(suffix)
            if not path.is_file() or path.stat().st_size != size:
                return f"but {path.name} is not as it was made"
        self._state = _recording_state(Path(self._job.source))
        if record["recording_state"] == self._state:
            known = str(record["identity"].get("recording", ""))
            self._identity = _identity_of(self._job, self._options, known)
        changed = _difference(record["identity"], self._current_identity())
        return changed and f"made from {changed}"

    def _current_identity(self) -> dict[str, Any]:
        if self._identity is None:
            # Before the content is read: a change meanwhile must not count as what was read.
            self._state = _recording_state(Path(self._job.source))
            self._identity = _identity_of(self._job, self._options)
        return self._identity


def _make_durable(path: Path) -> None:
    """Have the disk keep it before anything says that it is there."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _identity_of(job: Job, options: Options, recording: str = "") -> dict[str, Any]:
    """The identity of a job's results, as JSON has it.

    recording: digest of its content; where not known, the whole recording is read for it.
    """
    values = asdict(options)
    values["end_s"] = None if math.isinf(options.end_s) else options.end_s
    return {
        "recording": recording or _content_digest(Path(job.source)),
        "sensor": digest(Path(job.sensor).read_bytes()),
        "software": software_version(),
        "options": values,
    }


def _difference(found: dict[str, Any], expected: dict[str, Any]) -> str:
    """In what two identities differ, in words; empty where they do not."""
    changed = [words for key, words in WORDS.items() if found.get(key) != expected[key]]
    return " and ".join(changed)


def _content_digest(source: Path) -> str:
    """SHA-256 over names and contents of a file, or of the files of a folder.

    Raises OutputError where there is nothing to read.
    """
    files = list(_files_of(source))
    if not files:
        msg = f"{source}: found no file, expected a recording"
        raise OutputError(msg)
    return files_digest(files)


def _recording_state(source: Path) -> list[list[str | int]]:
    """Name, size and time of change (ns) of each file: while all stay, so does the content."""
    state: list[list[str | int]] = []
    for name, path in _files_of(source):
        facts = path.stat()
        state.append([name, facts.st_size, facts.st_mtime_ns])
    return state


@lru_cache(maxsize=1)
def software_version() -> str:
    """Changes with all that results are computed and written with."""
    parts = [f"{name} {_digest(name)}" for name in PACKAGES]
    parts.append(f"cmp_tactile_bringup {_digest('cmp_tactile_bringup')}")
    parts += [f"{name} {_version(name)}" for name in LIBRARIES]
    parts.append(f"opencv {_opencv()}")
    return ", ".join(parts)


def _files_of(source: Path) -> Iterator[tuple[str, Path]]:
    if source.is_file():
        yield source.name, source
        return
    for path in sorted(source.iterdir()):
        # No recording has hidden files or folders; results may have been put there.
        if path.is_file() and not path.name.startswith("."):
            yield path.name, path


def _digest(package: str) -> str:
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        msg = f"{package}: found no folder of its sources, expected an installed package"
        raise ModuleNotFoundError(msg)
    return source_digest(Path(spec.origin).parent)


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "absent"


def _opencv() -> str:
    import cv2

    return cv2.__version__
