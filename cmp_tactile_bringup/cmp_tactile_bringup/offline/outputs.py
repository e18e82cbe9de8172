"""What is written of a recording: its bag and its tables, without ROS.

MCAP with the topics of a running sensor; force and moment over time as CSV, and as Parquet with
types and units.
"""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.offline.jobs import OPTIONAL_SUFFIXES, Job
from cmp_tactile_bringup.recordings import results
from cmp_tactile_bringup.recordings.results import COLUMN_TYPES, COLUMNS, unit_of
from cmp_tactile_bringup.terminal import installed_version
from cmp_tactile_driver.bags.reader import RecordedFrame
from cmp_tactile_driver.bags.writer import LATCHED, BagWriter
from cmp_tactile_processing.cache.compiled import compiled_digest
from cmp_tactile_processing.cache.files import check_free, partial_folder
from cmp_tactile_processing.errors import OutputError
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.pipeline import PipelineResult
from cmp_tactile_processing.ros.messages import making
from cmp_tactile_processing.ros.messages.definitions import (
    bag_messages,
    simulation_definition,
    simulation_typestore,
)
from cmp_tactile_processing.ros.messages.making import CAMERA_INFO, FORCE_FIELD, GRID, SURFACE
from cmp_tactile_processing.sensor.description import SensorDescription

WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
# Of a surface, by their names there.
SURFACE_ARRAYS = (
    *("reference", "position", "displacement", "status", "ray_gap"),
    *("row_position", "col_position"),
)
Row = Sequence[float | str]
# Name below the sensor's namespace, type, message.
NamedMessage = tuple[str, str, Any]
# Takes a frame, what it showed, what is wrong with its stamp, and more messages about it.
Append = Callable[..., None]


def software_version() -> str:
    """What results are computed with: the version, and a digest of the sources."""
    return f"cmp_tactile {installed_version('cmp_tactile_processing')}, {compiled_digest()}"


def check_results_free(job: Job) -> None:
    """Raise OutputError where results are there and the job does not replace them."""
    check_free(map(job.path, job.options.suffixes), overwrite=job.overwrite)


@contextmanager
def whole_results(job: Job) -> Iterator[Path]:
    """A folder for the files of a job: they move to their places when all are written.

    Raises OutputError as `check_results_free` and `partial_folder` do.
    """
    with partial_folder(job.path("")) as partial:
        check_results_free(job)
        yield partial
        for suffix in OPTIONAL_SUFFIXES:
            job.path(suffix).unlink(missing_ok=True)
        # The bag last: where it is, the tables are.
        for made in sorted(partial.iterdir(), key=lambda path: path.suffix == ".mcap"):
            made.replace(Path(job.folder) / made.name)


class ResultBag:
    """Writes one MCAP file; the same results give the same bytes.

    Topics and frames are those of the nodes.  Messages bear the stamp of their frame and lie at the
    time at which it was recorded, so that the file plays along with the recording.  A context
    manager; the file is whole once that is left without an error.
    """

    def __init__(
        self, path: Path, sensor: SensorDescription, grids: Sequence[str], reference: str
    ) -> None:
        """grids: the views of which grids are written.  reference: of displacement, in words."""
        self._sensor, self._grids = sensor, tuple(grids)
        self._make = bag_messages()
        self._rectification = Rectification(sensor)
        facts = {"software": software_version(), "reference": reference}
        # A folder with the file and its metadata, of which only the file is wanted.
        folder = path.with_name(path.name.removesuffix(".mcap"))
        self._path, self._bag = path, BagWriter(folder, compressed=True, facts=facts)
        self._has_transforms = False

    def __enter__(self) -> ResultBag:
        return self

    def __exit__(self, *_: object) -> None:
        self._bag.close()
        self._bag.path.replace(self._path)
        shutil.rmtree(self._bag.folder)

    def append(
        self,
        frame: RecordedFrame,
        result: PipelineResult,
        more: Iterable[NamedMessage] = (),
    ) -> None:
        """Write what the next frame showed, and more messages about it."""
        if not self._has_transforms:
            transforms = making.static_transforms(self._make, self._sensor, self._rectification)
            message = self._make.new(TF_MESSAGE, transforms=transforms)
            self._write("/tf_static", TF_MESSAGE, message, frame)
            self._has_transforms = True
        for name, kind, message in (*self._messages(frame.stamp_ns, result), *more):
            self._write(f"/{self._sensor.ros_name}/{name}", kind, message, frame)

    def _messages(self, stamp: int, result: PipelineResult) -> Iterator[NamedMessage]:
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
        latched = topic == "/tf_static" or topic.endswith("/camera_info")
        qos = [LATCHED] if latched else []
        self._bag.add_topic(topic, kind, qos, simulation_definition(kind))
        data = bytes(simulation_typestore().serialize_cdr(message, kind))
        self._bag.write(topic, frame.time_ns, data)


@contextmanager
def csv_table(path: Path) -> Iterator[Callable[[Row], object]]:
    """Appends rows of COLUMNS to a CSV file; numbers are written with all their digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        yield writer.writerow


def write_parquet(table: Path, path: Path) -> None:
    """Make a Parquet file of a CSV table; each column's metadata has its `unit`, NaN stays NaN.

    Raises OutputError where pyarrow is not installed.
    """
    require_parquet()
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet as pq

    types = {name: pa.type_for_alias(COLUMN_TYPES.get(name, "double")) for name in COLUMNS}
    read = pyarrow.csv.read_csv(
        table, convert_options=pyarrow.csv.ConvertOptions(column_types=types, null_values=[])
    )
    schema = pa.schema(
        pa.field(name, types[name], nullable=False, metadata={"unit": unit_of(name)})
        for name in COLUMNS
    )
    pq.write_table(read.cast(schema), path)


def require_parquet() -> None:
    """Raise OutputError where Parquet cannot be written."""
    try:
        import pyarrow.parquet  # noqa: F401  only whether it is there
    except ImportError as error:
        msg = (
            f"--parquet: found no pyarrow ({error}), expected the package: pip install pyarrow; "
            "the CSV file has the same columns"
        )
        raise OutputError(msg) from None


@contextmanager
def result_files(folder: Path, job: Job, sensor: SensorDescription) -> Iterator[Append]:
    """Writes bag and tables of a job into a folder; appends to all of them at once."""
    options, table = job.options, folder / f"{job.name}_wrench.csv"
    bag = ResultBag(
        folder / f"{job.name}.mcap",
        sensor,
        options.grids_of(tuple(sensor.views)),
        options.reference,
    )
    with ExitStack() as files:
        files.enter_context(bag)
        append_row = files.enter_context(csv_table(table))
        arrays = None
        if options.arrays:
            arrays = files.enter_context(results.ArrayLog(folder / f"{job.name}.npz"))

        def append(
            frame: RecordedFrame,
            result: PipelineResult,
            stamp_fault: str = "",
            more: Iterable[NamedMessage] = (),
        ) -> None:
            bag.append(frame, result, more)
            append_row(results.table_row(frame.stamp_ns, frame.time_s, result.force, stamp_fault))
            if arrays is not None:
                arrays.append(_arrays(frame.stamp_ns, result))

        yield append
    if options.parquet:
        write_parquet(table, table.with_suffix(".parquet"))


def _arrays(stamp_ns: int, result: PipelineResult) -> dict[str, NDArray[Any]]:
    """What is kept of a frame; float32 keeps 1e-4 px and 1e-9 m."""
    surface = result.surface
    values: dict[str, NDArray[Any]] = {"stamp_ns": np.array(stamp_ns, np.int64)}
    for name, grid in (("left", result.left), ("right", result.right)):
        if grid is not None:
            values |= {f"{name}_{key}": array for key, array in results.grid_arrays(grid).items()}
    values |= {name: getattr(surface, name) for name in SURFACE_ARRAYS}
    values |= results.force_arrays(result.force)
    single = np.float32
    return {k: v.astype(single) if v.dtype == np.float64 else v for k, v in values.items()}
