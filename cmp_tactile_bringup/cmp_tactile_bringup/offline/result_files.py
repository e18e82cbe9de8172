"""Files of results that are there whole or not at all, whatever ends the process that makes them.

All are written in a hidden folder beside their places.  Its record, which comes last, says that
they are complete; then they are moved, and the record after them.  What is found of an interrupted
run is removed, or moved to its place where the record is there.

The record names what the results were made from: recording, sensor description, software, options.
The same means the same bytes of results, however they are made, on processors of one type.

Without ROS: MCAP with the topics of a running sensor; force and moment over time as CSV, and as
Parquet with types and units.
"""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_bringup.offline.jobs import Job, Options, Outcome
from cmp_tactile_bringup.recordings.results import COLUMN_TYPES, COLUMNS, unit_of
from cmp_tactile_driver.bags.reader import RecordedFrame
from cmp_tactile_processing.cache.compiled import source_digest
from cmp_tactile_processing.cache.files import atomic_path, digest, files_digest, locked
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.pipeline import PipelineResult
from cmp_tactile_processing.ros.messages import making
from cmp_tactile_processing.ros.messages.definitions import bag_messages, simulation_typestore
from cmp_tactile_processing.ros.messages.making import CAMERA_INFO, FORCE_FIELD, GRID, SURFACE
from cmp_tactile_processing.sensor.description import SensorDescription

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


WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
CHUNK_BYTES = 4 << 20
ROWS_IN_MEMORY = 4096
# What a player needs to offer late listeners the last message, as rosbag2 writes it.
LATCHED = """\
- history: keep_last
  depth: 1
  reliability: reliable
  durability: transient_local
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
"""


Row = Sequence[float | str]


class ResultBag:
    """Writes one MCAP file; the same results give the same bytes.

    Topics and frames are those of the nodes.  Messages bear the stamp of their frame and lie at the
    time at which it was recorded, so that the file plays along with the recording.  A context
    manager; the file is whole once that is left without an error.
    """

    def __init__(self, path: Path, sensor: SensorDescription, grids: Sequence[str]) -> None:
        """grids: the views of which grids are written."""
        self._sensor, self._grids = sensor, tuple(grids)
        self._make = bag_messages()
        self._rectification = Rectification(sensor)
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)
        self._writer.start("ros2", "cmp_tactile process")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, tuple[int, str]] = {}
        self._counts: dict[str, int] = {}
        self._began = False

    def __enter__(self) -> ResultBag:
        return self

    def __exit__(self, *error: object) -> None:
        try:
            if error[0] is None:
                self._writer.finish()
        finally:
            self._file.close()

    def describe(self, facts: Mapping[str, str], description: bytes) -> None:
        """Say what the results were made with; description: the file of the sensor."""
        self._writer.add_metadata("cmp_tactile", dict(facts))
        self._writer.add_attachment(0, 0, "sensor.yaml", "application/yaml", description)

    def append(self, frame: RecordedFrame, result: PipelineResult) -> None:
        """Write what the next frame showed."""
        if not self._began:
            self._began = True
            transforms = making.static_transforms(self._make, self._sensor, self._rectification)
            message = self._make.new(TF_MESSAGE, transforms=transforms)
            self._write("/tf_static", TF_MESSAGE, message, frame)
        for name, kind, message in self._messages(frame.stamp_ns, result):
            self._write(f"/{self._sensor.ros_name}/{name}", kind, message, frame)

    def _messages(self, stamp: int, result: PipelineResult) -> Iterator[tuple[str, str, Any]]:
        make, sensor = self._make, self._sensor
        gel = make.header(stamp, making.gel_frame(sensor))
        for view, grid in (("left", result.left), ("right", result.right)):
            if grid is None:
                continue
            header = make.header(stamp, making.rectified_frame(sensor, view))
            info = make.camera_info(self._rectification.info(view), header)
            yield f"{view}/camera_info", CAMERA_INFO, info
            if view in self._grids:
                header = make.header(stamp, making.view_frame(sensor, view))
                yield f"{view}/grid", GRID, make.grid(grid, header)
        yield "surface", SURFACE, make.surface(result.surface, gel)
        yield "force_field", FORCE_FIELD, make.force_field(result.force, gel)
        yield "wrench", WRENCH_STAMPED, make.wrench_stamped(result.force, gel)

    def _write(self, topic: str, kind: str, message: Any, frame: RecordedFrame) -> None:
        channel = self._channel(topic, kind)
        sequence = self._counts[topic] = self._counts.get(topic, -1) + 1
        data = bytes(simulation_typestore().serialize_cdr(message, kind))
        self._writer.add_message(channel, frame.time_ns, data, frame.stamp_ns, sequence)

    def _channel(self, topic: str, kind: str) -> int:
        if topic not in self._channels:
            if kind not in self._schemas:
                text, _ = simulation_typestore().generate_msgdef(kind, ros_version=2)
                self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
            latched = topic == "/tf_static" or topic.endswith("/camera_info")
            qos = {"offered_qos_profiles": LATCHED if latched else ""}
            number = self._writer.register_channel(topic, "cdr", self._schemas[kind], qos)
            self._channels[topic] = (number, kind)
        return self._channels[topic][0]


@contextmanager
def csv_table(path: Path) -> Iterator[Callable[[Row], object]]:
    """Appends rows of COLUMNS to a CSV file; numbers are written with all their digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        yield writer.writerow


@contextmanager
def parquet_table(path: Path) -> Iterator[Callable[[Row], object]]:
    """Appends rows of COLUMNS to a Parquet file; NaN stays NaN.

    Each column's metadata has its `unit`.  Raises OutputError where pyarrow is not installed.
    """
    require_parquet()
    import pyarrow as pa
    import pyarrow.parquet as pq

    types = {name: pa.type_for_alias(COLUMN_TYPES.get(name, "double")) for name in COLUMNS}
    schema = pa.schema(
        pa.field(name, types[name], nullable=False, metadata={"unit": unit_of(name)})
        for name in COLUMNS
    )
    rows: list[Row] = []

    def flush() -> None:
        columns = zip(*rows, strict=True)
        arrays = [pa.array(values, item.type) for values, item in zip(columns, schema, strict=True)]
        writer.write_batch(pa.record_batch(arrays, schema))
        rows.clear()

    def append(row: Row) -> None:
        rows.append(row)
        if len(rows) == ROWS_IN_MEMORY:
            flush()

    with pq.ParquetWriter(path, schema) as writer:
        yield append
        if rows:
            flush()


def require_parquet() -> None:
    """Raise OutputError where Parquet cannot be written."""
    try:
        import pyarrow.parquet  # noqa: F401  only whether it is there
    except ImportError as error:
        msg = (
            f"--parquet: found no pyarrow ({error}), expected it installed: "
            "`pip install pyarrow`; the CSV file has the same columns"
        )
        raise OutputError(msg) from None
