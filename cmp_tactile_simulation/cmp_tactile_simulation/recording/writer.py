"""Simulated frames as a ROS 2 bag (MCAP), without ROS, or as numbered images."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter

from cmp_tactile_driver.sources.files import decode_file
from cmp_tactile_processing.cache.files import atomic_path
from cmp_tactile_processing.measured import Grid, Surface
from cmp_tactile_processing.ros.messages.definitions import simulation_typestore
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.recording.frame_messages import (
    FrameMessages,
    encode_png,
    recorded_topics,
)
from cmp_tactile_simulation.recording.truth import (
    FrameBytes,
    WrittenFrame,
    recorded_frames,
    written_frame,
)
from cmp_tactile_simulation.scenes.simulation import SimulatedFrame


class RecordingWriter:
    """Writes one bag; all messages of a frame bear its stamp.

    The same frames give the same bytes.  Raises OutputError where the folder is there already.
    """

    def __init__(self, bag: Path, sensor: SensorDescription) -> None:
        self._bag = bag
        self._sensor = sensor
        self._messages = FrameMessages(sensor)
        self._topics = recorded_topics(sensor)
        self._writer = Writer(_checked(bag), version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        store = simulation_typestore()
        self._connections = {
            topic: self._writer.add_connection(self._topics.prefix + topic, kind, typestore=store)
            for topic, kind in self._topics.types.items()
        }

    def append(self, frame: SimulatedFrame) -> None:
        """Write the next frame."""
        for topic, data in self._messages.serialised(frame):
            self._writer.write(self._connections[topic], frame.stamp_ns, data)
        self._make_durable()

    def append_recorded(self, stamp_ns: int, frame: FrameBytes) -> None:
        """Write a frame that was recorded before: its messages by topic."""
        for topic, connection in self._connections.items():
            self._writer.write(connection, stamp_ns, frame[topic])
        self._make_durable()

    def close(self) -> None:
        """Write index and metadata.yaml; where there is no frame yet, there is no bag to index."""
        if any(self._writer.counts.values()):
            self._writer.close()
        else:
            self._writer.abort()

    def _make_durable(self) -> None:
        """A frame is a chunk of the file: should the process be killed, only the next is lost."""
        storage = self._writer.storage
        if isinstance(storage, McapWriter):
            storage.close_chunk()
            storage.bio.flush()

    def frames(self) -> Iterator[WrittenFrame]:
        """What was written."""
        for _, frame in recorded_frames(self._bag, self._sensor):
            yield written_frame(frame, self._sensor)


def _checked(bag: Path) -> Path:
    if bag.exists():
        msg = f"{bag}: exists already, expected a place for a new bag"
        raise OutputError(msg)
    return bag


# Simulated frames as numbered PNG files, each with an NPZ file of what is true of it.

LEAST_DIGITS = 3


class ImageWriter:
    """Writes NNN.png and NNN.npz into a folder; each file appears whole or not at all."""

    def __init__(self, folder: Path, frame_count: int) -> None:
        """frame_count: of the whole scene."""
        self._folder = folder
        self._digits = max(LEAST_DIGITS, len(str(frame_count - 1)))

    def written(self) -> int:
        """Number of frames, from the first, that are there already."""
        count = 0
        while all(path.is_file() for path in self._paths(count)):
            count += 1
        return count

    def append(self, frame: SimulatedFrame) -> None:
        """Write the next frame; the image last, so that none is without its truth."""
        image, arrays = self._paths(frame.index)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **true_arrays(frame))
        _write(arrays, buffer.getbuffer())
        _write(image, encode_png(frame.image).data)

    def close(self) -> None:
        """Nothing is left to do."""

    def frames(self) -> Iterator[WrittenFrame]:
        """What was written."""
        for number in range(self.written()):
            image, arrays = self._paths(number)
            with np.load(arrays, allow_pickle=False) as values:
                yield WrittenFrame(
                    image=decode_file(image),
                    corners_m=values["corners_m"],
                    displacement=values["displacement_m"],
                    force_position=values["force_position"],
                    force=values["force"],
                    wrench=values["wrench"],
                    contact_area=float(values["contact_area"]),
                )

    def _paths(self, number: int) -> tuple[Path, Path]:
        name = f"{number:0{self._digits}d}"
        return self._folder / f"{name}.png", self._folder / f"{name}.npz"


def true_arrays(frame: SimulatedFrame) -> dict[str, NDArray[Any]]:
    """The arrays of a frame's NPZ file; docs/scenes.md lists them."""
    optical = {
        key: values
        for view, grid in frame.grids.items()
        for key, values in _pixels(grid, view).items()
    }
    force = frame.force
    return {
        **optical,
        **_points(frame.surface),
        "stamp_ns": np.array(frame.stamp_ns, np.int64),
        "force_position": force.position,
        "force": force.force,
        "contact": force.contact,
        "wrench": force.wrench,
        "contact_area": np.array(force.contact_area),
        "centre_of_pressure": force.centre_of_pressure,
        "slip_state": np.array(int(force.slip_state), np.uint8),
        "indenter_position": frame.pose.position,
        "indenter_rotation": frame.pose.rotation,
    }


def _pixels(grid: Grid, view: str) -> dict[str, NDArray[np.float64]]:
    corners = grid.corners_frame
    return {
        f"corners_{view}_px": corners,
        f"row_lines_{view}_px": _line(corners, grid.row_lines_frame),
        f"col_lines_{view}_px": _line(corners.swapaxes(0, 1), grid.col_lines_frame.swapaxes(0, 1)),
    }


def _points(surface: Surface) -> dict[str, NDArray[np.float64]]:
    corners = surface.position
    return {
        "corners_m": corners,
        "displacement_m": surface.displacement,
        "row_lines_m": _line(corners, surface.row_position),
        "col_lines_m": _line(corners.swapaxes(0, 1), surface.col_position.swapaxes(0, 1)),
    }


def _line(corners: NDArray[np.float64], between: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points along each gridline, (lines, (m - 1) (n + 1) + 1, d): every (n + 1)th is a corner.

    corners (lines, m, d).  between (lines, m - 1, n, d).
    """
    lines, _, dimension = corners.shape
    segments = np.concatenate([corners[:, :-1, None], between], axis=2)
    return np.concatenate([segments.reshape(lines, -1, dimension), corners[:, -1:]], axis=1)


def _write(path: Path, data: memoryview) -> None:
    with atomic_path(path) as beside:
        beside.write_bytes(data)
