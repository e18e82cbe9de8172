"""Frames, bags and a ROS graph for the tests of the driver."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import made_bags
import numpy as np
import pytest
from fake_v4l2 import FakeCamera, FakeKernel
from numpy.typing import NDArray

from cmp_tactile_driver.sources.frames import SourceOptions
from cmp_tactile_driver.sources.parameters import CameraParameters
from cmp_tactile_driver.v4l2.source import V4L2Source
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor


@pytest.fixture
def frames() -> list[NDArray[np.uint8]]:
    return made_bags.frames(12)


@pytest.fixture
def image_folder(tmp_path: Path, frames: list[NDArray[np.uint8]]) -> Path:
    """The frames as 0.png, 1.png, ..., 11.png."""
    folder = tmp_path / "images"
    folder.mkdir()
    for number, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{number}.png"), frame)
    return folder


@pytest.fixture
def frame_bag(tmp_path: Path, frames: list[NDArray[np.uint8]]) -> Path:
    """The frames as raw images, with camera infos, at 20 Hz."""
    times = made_bags.stamps(len(frames))
    infos = [made_bags.camera_info(f, t) for f, t in zip(frames, times, strict=True)]
    topics = {"/rig/camera_info": infos, "/rig/image_raw": made_bags.images(frames)}
    return made_bags.write(tmp_path / "bag", topics)


@pytest.fixture
def install_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Installs a package of one module with frame sources: their names, and their functions."""

    def install(package: str, code: str, **sources: str) -> None:
        metadata = tmp_path / f"{package}-1.0.dist-info"
        metadata.mkdir()
        described = f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n"
        (metadata / "METADATA").write_text(described)
        lines = [f"{name} = {package}:{function}" for name, function in sources.items()]
        entry_points = "\n".join(["[cmp_tactile_frame_sources]", *lines, ""])
        (metadata / "entry_points.txt").write_text(entry_points)
        (tmp_path / f"{package}.py").write_text(code)
        monkeypatch.syspath_prepend(str(tmp_path))

    return install


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeKernel:
    """A machine without cameras, into which a test plugs some."""
    machine = FakeKernel(tmp_path / "machine")
    machine.install(monkeypatch)
    return machine


@pytest.fixture
def plug(kernel: FakeKernel) -> Callable[..., FakeCamera]:
    """Plugs a new camera in, by default as /dev/video0; returns it."""

    def plug_in(*args: Any, number: int = 0, port: str = "1-2", **fields: Any) -> FakeCamera:
        camera = FakeCamera(*args, **fields)
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
    return made_bags.frames(1)[0]


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
