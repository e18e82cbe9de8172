"""Recordings with ground truth: a ROS 2 bag of camera frames and, beside it, what is true of them.

A recording NAME is three things in one folder: the bag `NAME/` (metadata.yaml and MCAP), the
truth `NAME_truth.npz` and the notes `NAME.yaml` (sensor, title, phases).  Make one from a folder
of numbered frames (000.png, 000.npz, 001.png, ...) with

    python3 -m cmp_tactile_bringup.recording FRAMES DATA/NAME
"""

from __future__ import annotations

import argparse
import sys
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.typesys import Stores, get_typestore

from cmp_tactile_bringup.shared_files import share_folder
from cmp_tactile_processing.errors import CmpTactileError, FrameError
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_processing.sensor_library import load_sensor, packaged_sensors
from cmp_tactile_processing.yaml_section import YamlSection, read_yaml

__all__ = [
    "PACKAGED_RECORDING",
    "Phase",
    "Recording",
    "RecordingError",
    "Truth",
    "check_source",
    "find_recording",
    "packaged_bag",
    "required_sensor",
    "write_recording",
]

PACKAGED_RECORDING = "grasp"
FRAME_RATE = 30.0
FIRST_STAMP_NS = 1_750_000_000 * 10**9
MAX_TRUTH_BYTES = 50_000_000
TRUTH_KEYS = ("stamp_ns", "corners_left_px", "corners_right_px", "corners_m")
# Camera noise leaves PNG's dictionary nothing to find: entropy coding alone is both the smallest
# (21.9 MB against 23.8 MB for 60 frames) and seven times as fast.  OpenCV heeds the strategy only
# where a compression level is given too.
PNG_OPTIONS = (
    cv2.IMWRITE_PNG_COMPRESSION,
    6,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
)


class RecordingError(CmpTactileError):
    """A recording that cannot be read or made."""


@dataclass(frozen=True)
class Phase:
    """A part of the recording: its name and its first frame (counted from 0)."""

    name: str
    first_frame: int


@dataclass(frozen=True)
class Truth:
    """What is true of n frames; NaN where nothing is known.

    stamp_ns (n,) int64.  corners_left_px, corners_right_px (n, rows, cols, 2): px of the whole
    camera frame.  corners_m (n, rows, cols, 3): gel frame.
    """

    stamp_ns: NDArray[np.int64]
    corners_left_px: NDArray[np.float64]
    corners_right_px: NDArray[np.float64]
    corners_m: NDArray[np.float64]

    @classmethod
    def load(cls, path: Path) -> Truth:
        """Read a truth file; RecordingError where it is absent, damaged or incomplete."""
        try:
            _check_unpacked_size(path)
            with np.load(path, allow_pickle=False) as arrays:
                missing = [key for key in TRUTH_KEYS if key not in arrays]
                if missing:
                    msg = f"{path}: found no {', '.join(missing)}, expected {', '.join(TRUTH_KEYS)}"
                    raise RecordingError(msg)
                pixels_and_points = {key: arrays[key].astype(np.float64) for key in TRUTH_KEYS[1:]}
                return cls(stamp_ns=arrays["stamp_ns"].astype(np.int64), **pixels_and_points)
        except (OSError, ValueError, zipfile.BadZipFile) as error:
            msg = f"{path}: cannot be read as a truth file: {error}"
            raise RecordingError(msg) from None

    def save(self, path: Path) -> None:
        """Write a truth file; float32 keeps 1e-4 px and 1e-9 m, far below any error of interest."""
        arrays = {key: getattr(self, key).astype(np.float32) for key in TRUTH_KEYS[1:]}
        np.savez_compressed(path, allow_pickle=False, stamp_ns=self.stamp_ns, **arrays)


@dataclass(frozen=True)
class Recording:
    """A bag, its truth and what its notes say."""

    bag: Path
    truth: Truth
    sensor: str
    title: str
    phases: tuple[Phase, ...]


def find_recording(name_or_path: str = PACKAGED_RECORDING) -> Recording:
    """A packaged recording by name, or the one whose bag folder is given.

    Raises RecordingError where there is no such bag or truth, DescriptionError for wrong notes.
    """
    bag = Path(name_or_path).expanduser()
    if name_or_path == bag.name and not bag.exists():
        bag = share_folder() / "data" / name_or_path
    if not (bag / "metadata.yaml").is_file():
        msg = f"{bag}: found no metadata.yaml, expected the folder of a ROS 2 bag"
        raise RecordingError(msg)
    notes = read_yaml(bag.with_name(f"{bag.name}.yaml"))
    recording = Recording(
        bag=bag,
        truth=Truth.load(bag.with_name(f"{bag.name}_truth.npz")),
        sensor=notes.text("sensor"),
        title=notes.text("title"),
        phases=tuple(_read_phase(item) for item in notes.sections("phases")),
    )
    notes.finish()
    return recording


def packaged_bag(source: Path) -> Path:
    """The bag of a packaged recording where its name is given and no such path is there."""
    if str(source) == PACKAGED_RECORDING and not source.exists():
        return share_folder() / "data" / PACKAGED_RECORDING
    return source.expanduser()


def check_source(source: Path, kinds: str) -> None:
    """Raise RecordingError where there is no such path; kinds: what may be there."""
    if not source.exists():
        msg = (
            f"{source}: found no such file or folder, expected {kinds}, or the packaged recording "
            f"{PACKAGED_RECORDING}"
        )
        raise RecordingError(msg)


def required_sensor(source: Path, given: str | None) -> str:
    """The sensor that was given, or the one that the notes beside a bag name.

    Raises RecordingError where there is neither, DescriptionError for notes that cannot be read.
    """
    if given:
        return given
    notes = source.with_name(f"{source.name}.yaml")
    if (source / "metadata.yaml").is_file() and notes.is_file():
        return read_yaml(notes).text("sensor")
    packaged = ", ".join(packaged_sensors())
    msg = f"{source}: found no --sensor, expected the file of a description or one of {packaged}"
    raise RecordingError(msg)


def write_recording(frames: Path, bag: Path, sensor: SensorDescription) -> int:
    """Write the frames of a folder as a bag, and their truth beside it; returns their number.

    Frames are NNN.png of the sensor's size, at 30 Hz; NNN.npz of each holds its truth, if any.
    Raises RecordingError for an empty folder or an existing bag, FrameError for a wrong frame.
    """
    paths = sorted(frames.glob("*.png"))
    if not paths:
        msg = f"{frames}: found no *.png, expected numbered frames"
        raise RecordingError(msg)
    stamps = [FIRST_STAMP_NS + round(k * 1e9 / FRAME_RATE) for k in range(len(paths))]
    try:
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            _write_messages(writer, list(zip(stamps, paths, strict=True)), sensor)
    except WriterError as error:
        msg = f"{bag}: {error}"
        raise RecordingError(msg) from None
    truths = [path.with_suffix(".npz") for path in paths]
    if all(path.exists() for path in truths):
        _read_frame_truths(stamps, truths).save(bag.with_name(f"{bag.name}_truth.npz"))
    return len(paths)


def _write_messages(
    writer: Writer, frames: Sequence[tuple[int, Path]], sensor: SensorDescription
) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    topics = {
        f"/{sensor.ros_name}/camera_info": "sensor_msgs/msg/CameraInfo",
        f"/{sensor.ros_name}/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    }
    info, image = (writer.add_connection(*item, typestore=store) for item in topics.items())
    for stamp_ns, path in frames:
        header = _header(store, stamp_ns, f"{sensor.ros_name}_camera_optical_frame")
        info_msg = _camera_info(store, header, sensor)
        image_msg = store.types["sensor_msgs/msg/CompressedImage"](
            header=header, format="mono8; png compressed ", data=_encode(path, sensor)
        )
        for connection, message in ((info, info_msg), (image, image_msg)):
            data = store.serialize_cdr(message, connection.msgtype)
            writer.write(connection, stamp_ns, data)


def _header(store: Any, stamp_ns: int, frame_id: str) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)


def _camera_info(store: Any, header: Any, sensor: SensorDescription) -> Any:
    camera = sensor.camera
    if camera is None:
        msg = f"sensor {sensor.name}: found a camera per view, expected one for the whole frame"
        raise RecordingError(msg)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return store.types["sensor_msgs/msg/CameraInfo"](
        header=header,
        height=sensor.image.height,
        width=sensor.image.width,
        distortion_model="plumb_bob" if camera.model == "pinhole" else "equidistant",
        d=np.array(camera.distortion),
        k=matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.column_stack([matrix, np.zeros(3)]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def _encode(path: Path, sensor: SensorDescription) -> NDArray[np.uint8]:
    frame = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    expected = (sensor.image.height, sensor.image.width)
    if frame is None or frame.shape != expected:
        found = "no image" if frame is None else f"{frame.shape[1]} x {frame.shape[0]} px"
        msg = f"{path}: found {found}, expected {expected[1]} x {expected[0]} px"
        raise FrameError(msg)
    return cv2.imencode(".png", frame, PNG_OPTIONS)[1].ravel()


def _read_frame_truths(stamps: Sequence[int], paths: Sequence[Path]) -> Truth:
    arrays: dict[str, list[NDArray[np.float64]]] = {key: [] for key in TRUTH_KEYS[1:]}
    for path in paths:
        with np.load(path, allow_pickle=False) as frame:
            for key, values in arrays.items():
                values.append(frame[key])
    stacked = {key: np.stack(values) for key, values in arrays.items()}
    return Truth(stamp_ns=np.array(stamps, np.int64), **stacked)


def _read_phase(section: YamlSection) -> Phase:
    phase = Phase(section.text("name"), section.integer("first_frame", 0, 10**9))
    section.finish()
    return phase


def _check_unpacked_size(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        size = sum(item.file_size for item in archive.infolist())
    if size > MAX_TRUTH_BYTES:
        msg = f"{path}: found {size} bytes unpacked, expected at most {MAX_TRUTH_BYTES}"
        raise RecordingError(msg)


def main() -> int:
    """Make a recording from a folder of frames."""
    parser = argparse.ArgumentParser(
        prog="python3 -m cmp_tactile_bringup.recording",
        description="Write numbered frames (NNN.png with NNN.npz) as a ROS 2 bag with truth.",
    )
    parser.add_argument("frames", type=Path, help="folder of frames")
    parser.add_argument("bag", type=Path, help="folder of the bag to be made")
    parser.add_argument("--sensor", default="sample_rig", help="sensor description")
    arguments = parser.parse_args()
    try:
        count = write_recording(arguments.frames, arguments.bag, load_sensor(arguments.sensor))
    except CmpTactileError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{count} frames written to {arguments.bag}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
