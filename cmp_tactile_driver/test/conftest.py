"""Frames, bags and a ROS graph for the tests of the driver."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from cmp_tactile_driver.sources.frames import SourceOptions
from cmp_tactile_driver.sources.parameters import CameraParameters
from cmp_tactile_driver.v4l2.source import V4L2Source
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor

FIRST_STAMP_NS = 1_700_000_000 * 10**9
FRAME_NS = 50_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)


def make_frames(count: int, height: int = 48, width: int = 64) -> list[NDArray[np.uint8]]:
    """Frames of noise, so that no two are alike."""
    generator = np.random.default_rng(7)
    return [generator.integers(0, 256, (height, width), np.uint8) for _ in range(count)]


@pytest.fixture
def frames() -> list[NDArray[np.uint8]]:
    return make_frames(12)


@pytest.fixture
def image_folder(tmp_path: Path, frames: list[NDArray[np.uint8]]) -> Path:
    """The frames as 0.png, 1.png, ..., 11.png."""
    folder = tmp_path / "images"
    folder.mkdir()
    for number, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{number}.png"), frame)
    return folder


def _header(stamp_ns: int) -> Any:
    stamp = STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id="rig_camera_optical_frame")


def image_message(frame: NDArray[np.uint8], stamp_ns: int, **changes: Any) -> Any:
    """A sensor_msgs/Image of rosbags; mono8, or bgr8 where that is asked for."""
    fields = {
        "header": _header(stamp_ns),
        "height": frame.shape[0],
        "width": frame.shape[1],
        "encoding": "mono8" if frame.ndim == 2 else "bgr8",
        "is_bigendian": 0,
        "step": frame[0].nbytes,
        "data": frame.ravel(),
    }
    return STORE.types["sensor_msgs/msg/Image"](**{**fields, **changes})


def compressed_message(frame: NDArray[np.uint8], stamp_ns: int) -> Any:
    """The frame as PNG in a sensor_msgs/CompressedImage."""
    return STORE.types["sensor_msgs/msg/CompressedImage"](
        header=_header(stamp_ns),
        format="mono8; png compressed ",
        data=cv2.imencode(".png", frame)[1].ravel(),
    )


def camera_info_message(frame: NDArray[np.uint8], stamp_ns: int) -> Any:
    """A calibration that no sensor description has."""
    roi = STORE.types["sensor_msgs/msg/RegionOfInterest"](1, 2, 3, 4, do_rectify=True)
    return STORE.types["sensor_msgs/msg/CameraInfo"](
        header=_header(stamp_ns),
        height=frame.shape[0],
        width=frame.shape[1],
        distortion_model="plumb_bob",
        d=np.array([0.1, 0.2, 0.3, 0.4, 0.5]),
        k=np.arange(9.0),
        r=np.eye(3).ravel(),
        p=np.arange(12.0),
        binning_x=2,
        binning_y=2,
        roi=roi,
    )


def write_bag(
    path: Path, topics: dict[str, Sequence[Any]], storage: StoragePlugin = StoragePlugin.MCAP
) -> Path:
    """A bag of messages by topic; message k is recorded at its stamp, or at k frame times."""
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections = {
            topic: writer.add_connection(topic, messages[0].__msgtype__, typestore=STORE)
            for topic, messages in topics.items()
        }
        rows = []
        for order, (topic, messages) in enumerate(topics.items()):
            for number, message in enumerate(messages):
                rows.append((FIRST_STAMP_NS + number * FRAME_NS, order, topic, message))
        for time_ns, _, topic, message in sorted(rows, key=lambda row: row[:2]):
            connection = connections[topic]
            data = STORE.serialize_cdr(message, connection.msgtype)
            writer.write(connection, time_ns, data)
    return path


def stamps(count: int) -> list[int]:
    """The stamps of the frames of `frame_bag`."""
    return [FIRST_STAMP_NS + number * FRAME_NS for number in range(count)]


class Bags:
    """What the tests need to make bags."""

    image = staticmethod(image_message)
    compressed = staticmethod(compressed_message)
    camera_info = staticmethod(camera_info_message)
    write = staticmethod(write_bag)
    stamps = staticmethod(stamps)
    frames = staticmethod(make_frames)


@pytest.fixture
def bags() -> type[Bags]:
    return Bags


@pytest.fixture
def frame_bag(tmp_path: Path, frames: list[NDArray[np.uint8]]) -> Path:
    """The frames as raw images, with camera infos, at 20 Hz."""
    times = stamps(len(frames))
    return write_bag(
        tmp_path / "bag",
        {
            "/rig/camera_info": [
                camera_info_message(f, t) for f, t in zip(frames, times, strict=True)
            ],
            "/rig/image_raw": [image_message(f, t) for f, t in zip(frames, times, strict=True)],
        },
    )


@pytest.fixture(scope="session")
def fake() -> Iterator[ModuleType]:
    """The package fake_v4l2: cameras that answer as the kernel does."""
    folder = Path(__file__).parent / "fake_v4l2"
    spec = importlib.util.spec_from_file_location(
        folder.name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[folder.name] = module
    spec.loader.exec_module(module)
    yield module
    for name in [name for name in sys.modules if name.partition(".")[0] == folder.name]:
        del sys.modules[name]


@pytest.fixture
def kernel(fake: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A machine without cameras, into which a test plugs some."""
    machine = fake.FakeKernel(tmp_path / "machine")
    machine.install(monkeypatch)
    return machine


@pytest.fixture
def plug(fake: ModuleType, kernel: Any) -> Any:
    """Plugs a new camera in, by default as /dev/video0; returns it."""

    def plug_in(*args: Any, number: int = 0, port: str = "1-2", **fields: Any) -> Any:
        camera = fake.FakeCamera(*args, **fields)
        kernel.plug(camera, number, port)
        return camera

    return plug_in


@pytest.fixture
def small_sensor() -> SensorDescription:
    """A sensor with frames of 64 x 48 px."""
    sensor = load_sensor("sample_rig")
    return replace(sensor, image=replace(sensor.image, width=64, height=48))


@pytest.fixture
def picture() -> NDArray[np.uint8]:
    """What the camera of `small_sensor` sees."""
    return make_frames(1, 48, 64)[0]


@pytest.fixture
def open_source(small_sensor: SensorDescription) -> Iterator[Any]:
    """Opens a source `v4l2` with short times; closes it after the test."""
    opened = []

    def make(device: str = "CAM1", frame_rate: float = 0.0, **camera: Any) -> V4L2Source:
        times = {"frame_timeout": 0.15, "reconnect_delay": 0.02}
        settings = CameraParameters(**{"device": device, **times, **camera})
        opened.append(V4L2Source(SourceOptions("", small_sensor, frame_rate, camera=settings)))
        return opened[-1]

    yield make
    for source in opened:
        source.close()


@pytest.fixture
def handles() -> Callable[[], tuple[int, int]]:
    """Counts the open files and the mapped buffers of this process."""

    def count() -> tuple[int, int]:
        maps = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
        files = list(Path("/proc/self/fd").iterdir())
        return len(files), sum("/dev/video" in line for line in maps)

    return count
