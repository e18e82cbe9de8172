"""Files of results that are there whole or not at all, whatever ends the process that makes them.

All are written in a hidden folder beside their places.  Its record, which comes last, says that
they are complete; then they are moved, and the record after them.  What is found of an interrupted
run is removed, or moved to its place where the record is there.

The record names what the results were made from (`identity`).
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_bringup.offline.identity import made_from
from cmp_tactile_bringup.offline.jobs import Job, Options, Outcome
from cmp_tactile_processing.cache.files import atomic_path, locked

RECORD = "_process.json"
VERSION = 1
# The lock of a run that was just killed is gone in a moment.
SECONDS_FOR_LOCK = 3.0
OPTIONAL = (".npz", "_wrench.parquet")
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
        self._facts: dict[str, Any] | None = None

    def __enter__(self) -> ResultFiles:
        Path(self._job.folder).mkdir(parents=True, exist_ok=True)
        lock = locked(self._job.path("").with_name(f".{self._job.name}.lock"), SECONDS_FOR_LOCK)
        with ExitStack() as stack:
            try:
                stack.enter_context(lock)
            except TimeoutError:
                msg = f"{self._job.path('')}: another process is writing these results"
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
        record, reason = self._read_record(), "made from unknown input"
        if record is not None:
            reason = self._mismatch(record)
            if not reason:
                return Outcome.from_record(record["outcome"])
        for path in map(self._job.path, (*self._options.suffixes, RECORD)):
            if path.exists() and not overwrite:
                msg = f"{path}: exists already, {reason}; --overwrite replaces it"
                raise OutputError(msg)
        return None

    def begin(self) -> Path:
        """An empty folder for the files, each to be named by its suffix alone."""
        # As they are now: should the recording change meanwhile, the next run is to see it.
        self._facts = self._facts or made_from(self._job, self._options)
        self._partial.mkdir()
        return self._partial

    def complete(self, outcome: Outcome) -> None:
        """Move the files to their places, and remove what an earlier run made besides."""
        for suffix in self._options.suffixes:
            _make_durable(self._partial / suffix)
        record = {
            "version": VERSION,
            **(self._facts or {}),
            "outcome": asdict(outcome),
            "files": {s: (self._partial / s).stat().st_size for s in self._options.suffixes},
        }
        with atomic_path(self._partial / RECORD) as beside:
            beside.write_text(json.dumps(record, indent=1), encoding="utf-8")
        _make_durable(self._partial)
        earlier = self._read_record() or {"files": ()}
        self._move()
        for suffix in set(earlier["files"]) & set(OPTIONAL) - set(self._options.suffixes):
            self._job.path(suffix).unlink(missing_ok=True)

    def _move(self) -> None:
        for path in sorted(self._partial.iterdir(), key=lambda path: path.name == RECORD):
            path.replace(self._job.path(path.name))

    def _remove_partial(self) -> None:
        if self._partial.exists():
            shutil.rmtree(self._partial)

    def _read_record(self) -> dict[str, Any] | None:
        try:
            record = dict(json.loads(self._job.path(RECORD).read_text(encoding="utf-8")))
            Outcome.from_record(record["outcome"])
            dict(record["identity"]), dict(record["files"]), list(record["recording_state"])
            return record if record["version"] == VERSION else None
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def _mismatch(self, record: Mapping[str, Any]) -> str:
        for suffix, size in record["files"].items():
            path = self._job.path(suffix)
            if not path.is_file() or path.stat().st_size != size:
                return f"but {path.name} has changed since"
        self._facts = made_from(self._job, self._options, record)
        found, expected = record["identity"], self._facts["identity"]
        changed = [words for key, words in WORDS.items() if found.get(key) != expected[key]]
        return (changed and "made from " + " and ".join(changed)) or ""


def _make_durable(path: Path) -> None:
    """Have the disk keep it before anything says that it is there."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
