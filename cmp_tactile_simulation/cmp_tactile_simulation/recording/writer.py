"""Simulated frames as a ROS 2 bag (MCAP), without ROS, as numbered images, or as a video.

The video shows each frame, and beside it what is true of it.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
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
from cmp_tactile_simulation.recording import truth
from cmp_tactile_simulation.scenes.description import Motion, Scene
from cmp_tactile_simulation.scenes.simulation import SimulatedFrame


class RecordingWriter:
    """Writes one bag; all messages of a frame bear its stamp.

    The same frames give the same bytes.  Raises OutputError where the folder is there already.
    """

    def __init__(self, bag: Path, sensor: SensorDescription) -> None:
        self._bag = bag
        self._sensor = sensor
        self._messages = truth.FrameMessages(sensor)
        self._topics = truth.recorded_topics(sensor)
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

    def append_recorded(self, stamp_ns: int, frame: truth.FrameBytes) -> None:
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

    def frames(self) -> Iterator[truth.WrittenFrame]:
        """What was written."""
        for _, frame in truth.recorded_frames(self._bag, self._sensor):
            yield truth.written_frame(frame, self._sensor)


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
        _write(image, truth.encode_png(frame.image).data)

    def close(self) -> None:
        """Nothing is left to do."""

    def frames(self) -> Iterator[truth.WrittenFrame]:
        """What was written."""
        for number in range(self.written()):
            image, arrays = self._paths(number)
            with np.load(arrays, allow_pickle=False) as values:
                yield truth.WrittenFrame(
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


Colour = tuple[int, int, int]

HEIGHT_PX = 768
MAP_PX = 480
MARGIN_PX = 24
PANEL_PX = MAP_PX + 2 * MARGIN_PX
INK: Colour = (235, 235, 235)
FAINT: Colour = (150, 150, 150)
ARROW: Colour = (255, 255, 255)
BACKGROUND: Colour = (32, 28, 26)
# The colours span this depth at least, so that a gel at rest looks flat.
LEAST_DEPTH_M = 1e-4
# Force nodes are finer than arrows can be drawn.
ARROWS_ACROSS = 16
LONGEST_ARROW_PX = 45.0
# The arrows are scaled to the largest force a node had so far, and to this at least.
LEAST_FORCE_N = 0.02
CODEC = "mp4v"
SUBPIXEL_BITS = 4


def write_video(
    path: Path,
    frames: Iterable[truth.WrittenFrame],
    scene: Scene,
    on_frame: Callable[[int], None] = lambda _done: None,
) -> None:
    """Write frames with their truth beside them as an MP4 file at the scene's rate.

    on_frame: called with the number of frames done.  Raises OutputError where OpenCV cannot write
    videos there, and where not all frames can be read again, as from a full disk.
    """
    partial = path.with_name(f".partial.{path.name}")
    motion = Motion(scene.motion)
    writer = None
    scale = _Scale()
    number = -1
    for number, frame in enumerate(frames):
        title = f"{scene.title}: {motion.phase(number).name}, {number / scene.rate:.2f} s"
        picture = draw_frame(frame, title, scale)
        if writer is None:
            writer = _open(partial, picture, scene.rate)
        writer.write(picture)
        on_frame(number + 1)
    if writer is None:
        msg = f"{path}: found no frame to draw"
        raise OutputError(msg)
    writer.release()
    found = _readable_frames(partial)
    if found != number + 1:
        partial.unlink(missing_ok=True)
        msg = f"{path}: found {found} frames written, expected {number + 1}; is the disk full?"
        raise OutputError(msg)
    partial.replace(path)


class _Scale:
    """What full colour and the longest arrow stand for: the largest value so far."""

    def __init__(self) -> None:
        self.depth_m = LEAST_DEPTH_M
        self.force_n = LEAST_FORCE_N

    def include(self, depth_m: float, force_n: float) -> None:
        self.depth_m = max(self.depth_m, depth_m)
        self.force_n = max(self.force_n, force_n)


def draw_frame(
    frame: truth.WrittenFrame, title: str, scale: _Scale | None = None
) -> NDArray[np.uint8]:
    """The picture (768, w, 3) uint8 BGR: camera frame, depth map with force arrows, wrench."""
    scale = scale or _Scale()
    image = cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR)
    ratio = HEIGHT_PX / image.shape[0]
    # Video codecs want even sides.
    size = (2 * round(image.shape[1] * ratio / 2), HEIGHT_PX)
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    panel = np.full((HEIGHT_PX, PANEL_PX, 3), BACKGROUND, np.uint8)
    at = slice(MARGIN_PX, MARGIN_PX + MAP_PX)
    panel[at, at] = _map(frame, scale)
    _write_lines(panel, _lines(frame, title, scale))
    return np.asarray(np.hstack([image, panel]), np.uint8)


def _map(frame: truth.WrittenFrame, scale: _Scale) -> NDArray[np.uint8]:
    """Depth by colour with force arrows; x to the right, y upwards, as seen from the object."""
    depth = np.nan_to_num(-frame.displacement[..., 2])
    sums, places = _arrows(frame)
    in_plane = np.linalg.norm(sums[:, :2], axis=1)
    scale.include(float(depth.max()), float(in_plane.max(initial=0.0)))
    grey = (np.clip(depth / scale.depth_m, 0, 1) * 255).astype(np.uint8)
    large = cv2.resize(grey[::-1], (MAP_PX, MAP_PX), interpolation=cv2.INTER_CUBIC)
    picture = cv2.applyColorMap(large, cv2.COLORMAP_VIRIDIS)
    to_px = _pixel_map(frame)
    for force, place in zip(sums, places, strict=True):
        length = float(np.linalg.norm(force[:2])) / scale.force_n * LONGEST_ARROW_PX
        if length >= 1.0:
            start = to_px(place)
            step = force[:2] / scale.force_n * LONGEST_ARROW_PX * (1, -1)
            tail, tip = _fixed_point(start), _fixed_point(start + step)
            cv2.arrowedLine(
                picture, tail, tip, ARROW, 1, cv2.LINE_AA, shift=SUBPIXEL_BITS, tipLength=0.3
            )
    return np.asarray(picture, np.uint8)


def _fixed_point(pixel: NDArray[np.float64]) -> tuple[int, int]:
    """As OpenCV takes parts of pixels."""
    x, y = np.round(pixel * 2**SUBPIXEL_BITS).astype(int).tolist()
    return x, y


def _pixel_map(frame: truth.WrittenFrame) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Pixels of the map for points at rest."""
    rest = (frame.corners_m - frame.displacement)[..., :2].reshape(-1, 2)
    low, high = np.nanmin(rest, axis=0), np.nanmax(rest, axis=0)

    def to_px(point: NDArray[np.float64]) -> NDArray[np.float64]:
        share = (point[:2] - low) / (high - low)
        return np.asarray(MAP_PX * np.array([share[0], 1.0 - share[1]]))

    return to_px


def _arrows(frame: truth.WrittenFrame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Forces (n, 3) N summed over blocks of nodes, and the blocks' places (n, 3) m."""
    low, high = frame.force_position.min(axis=0)[:2], frame.force_position.max(axis=0)[:2]
    cell = ((frame.force_position[:, :2] - low) / (high - low) * ARROWS_ACROSS).astype(np.intp)
    cell = np.minimum(cell, ARROWS_ACROSS - 1)
    number = cell[:, 1] * ARROWS_ACROSS + cell[:, 0]
    count = np.maximum(np.bincount(number, minlength=ARROWS_ACROSS**2), 1)[:, None]

    def sums(values: NDArray[np.float64]) -> NDArray[np.float64]:
        columns = [np.bincount(number, values[:, k], ARROWS_ACROSS**2) for k in range(3)]
        return np.stack(columns, axis=1)

    return sums(frame.force), sums(frame.force_position) / count


def _lines(frame: truth.WrittenFrame, title: str, scale: _Scale) -> list[tuple[str, Colour]]:
    fx, fy, fz, mx, my, mz = frame.wrench.tolist()
    depth = 1e3 * float(np.nanmax(-frame.displacement[..., 2]))
    key = f"colour: depth to {1e3 * scale.depth_m:.2f} mm   arrow: shear to {scale.force_n:.3f} N"
    return [
        (title, INK),
        (f"F  {fx:+8.3f} {fy:+8.3f} {fz:+8.3f} N", INK),
        (f"M  {1e3 * mx:+8.2f} {1e3 * my:+8.2f} {1e3 * mz:+8.2f} N mm", INK),
        (f"depth {depth:.3f} mm   contact {1e6 * frame.contact_area:.1f} mm2", INK),
        (key, FAINT),
    ]


def _write_lines(panel: NDArray[np.uint8], lines: list[tuple[str, Colour]]) -> None:
    y = MARGIN_PX + MAP_PX + 36
    for text, colour in lines:
        size, _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
        scale = 0.55 * min(1.0, MAP_PX / size[0])
        cv2.putText(
            panel, text, (MARGIN_PX, y), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA
        )
        y += 36


def _readable_frames(path: Path) -> int:
    """Read them all: OpenCV's writer reports no error, and a header may promise what is lost."""
    video = cv2.VideoCapture(str(path))
    try:
        count = 0
        while video.grab():
            count += 1
        return count
    finally:
        video.release()


def _open(path: Path, picture: NDArray[np.uint8], rate: float) -> cv2.VideoWriter:
    height, width = picture.shape[:2]
    codec = cv2.VideoWriter.fourcc(*CODEC)
    writer = cv2.VideoWriter(str(path), codec, rate, (width, height))
    if not writer.isOpened():
        msg = f"{path}: OpenCV cannot write a video there"
        raise OutputError(msg)
    return writer
