"""Simulated frames as a ROS 2 bag (MCAP), without ROS, or as numbered images."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.bags.mcap_writer import McapFile
from cmp_tactile_driver.bags.writer import BagTopic, write_metadata
from cmp_tactile_driver.sources.files import decode_file
from cmp_tactile_processing.cache.files import atomic_path
from cmp_tactile_processing.measured import Grid, Surface, gridline_points
from cmp_tactile_processing.ros.messages.definitions import simulation_definition
from cmp_tactile_processing.ros.messages.reading import image_from_msg
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.recording import truth
from cmp_tactile_simulation.scenes.simulation import SimulatedFrame

LEAST_DIGITS = 3


@dataclass(frozen=True)
class WrittenFrame:
    """What the video shows of a frame that was written.

    image (H, W) uint8.  corners_m, displacement (rows, cols, 3) m, NaN where missing.
    force_position (M, 3) m, force (M, 3) N, wrench (6,) N and N m, contact_area m^2.
    """

    image: NDArray[np.uint8]
    corners_m: NDArray[np.float64]
    displacement: NDArray[np.float64]
    force_position: NDArray[np.float64]
    force: NDArray[np.float64]
    wrench: NDArray[np.float64]
    contact_area: float


class FrameOutput(Protocol):
    """Takes the frames of one scene in order."""

    def append(self, frame: SimulatedFrame) -> None:
        """Write the next frame."""

    def close(self) -> None:
        """Make what was written readable for others; nothing may be appended afterwards."""

    def frames(self) -> Iterator[WrittenFrame]:
        """What was written, once it is closed."""


class RecordingWriter:
    """Writes one bag; all messages of a frame bear its stamp.

    The same frames give the same bytes.  A frame is a chunk of the file: should the process be
    killed, only the next one is lost.
    """

    def __init__(self, bag: Path, sensor: SensorDescription, kept: int = 0) -> None:
        """kept: how many frames, from the first, stay of an interrupted run's bag."""
        self._bag, self._sensor = bag, sensor
        self._messages = truth.FrameMessages(sensor)
        self._prefix, types = truth.recorded_topics(sensor)
        self._topics = [
            BagTopic(self._prefix + name, kind, simulation_definition(kind))
            for name, kind in types.items()
        ]
        bag.mkdir(parents=True, exist_ok=True)
        path = bag / f"{bag.name}.mcap"
        # The old file is read until the new one takes its place.
        beside = path.with_name(f".{path.name}.partial")
        beside.unlink(missing_ok=True)
        self._file = McapFile(beside, compressed=False)
        for topic in self._topics:
            self._file.add_topic(topic.name, topic.kind, topic.definition.text)
        for stamp_ns, frame in islice(truth.recorded_frames(bag, sensor), kept):
            self._write(stamp_ns, frame.items())
        self._file.move(path)

    def append(self, frame: SimulatedFrame) -> None:
        """Write the next frame."""
        self._write(frame.stamp_ns, self._messages.serialised(frame))

    def close(self) -> None:
        """Write index and metadata.yaml."""
        self._file.close()
        write_metadata(self._bag, [self._file], self._topics)

    def frames(self) -> Iterator[WrittenFrame]:
        """What was written."""
        for _, frame in truth.recorded_frames(self._bag, self._sensor):
            yield self._written(frame)

    def _write(self, stamp_ns: int, messages: Iterable[tuple[str, bytes]]) -> None:
        for name, data in messages:
            self._file.write(self._prefix + name, stamp_ns, stamp_ns, data)
        self._file.flush()

    def _written(self, frame: truth.FrameBytes) -> WrittenFrame:
        image = truth.deserialised(frame, "image_raw/compressed", self._sensor)
        surface = truth.true_surface(frame, self._sensor)
        force = truth.true_force(frame, self._sensor)
        return WrittenFrame(
            image=image_from_msg(image),
            corners_m=surface.position,
            displacement=surface.displacement,
            force_position=force.position,
            force=force.force,
            wrench=force.wrench,
            contact_area=force.contact_area,
        )


class ImageWriter:
    """Writes NNN.png and NNN.npz into a folder; each file appears whole or not at all."""

    def __init__(self, folder: Path, frame_count: int) -> None:
        """frame_count: of the whole scene."""
        folder.mkdir(parents=True, exist_ok=True)
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
        _write(image, truth.encode_png(frame.image).data)

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
        f"row_lines_{view}_px": gridline_points(corners, grid.row_lines_frame),
        f"col_lines_{view}_px": gridline_points(
            corners.swapaxes(0, 1), grid.col_lines_frame.swapaxes(0, 1)
        ),
    }


def _points(surface: Surface) -> dict[str, NDArray[np.float64]]:
    corners = surface.position
    return {
        "corners_m": corners,
        "displacement_m": surface.displacement,
        "row_lines_m": gridline_points(corners, surface.row_position),
        "col_lines_m": gridline_points(corners.swapaxes(0, 1), surface.col_position.swapaxes(0, 1)),
    }


def _write(path: Path, data: memoryview) -> None:
    with atomic_path(path) as beside:
        beside.write_bytes(data)
