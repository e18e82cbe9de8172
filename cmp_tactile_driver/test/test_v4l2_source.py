"""The source `v4l2`, by linuxpy, on cameras that answer as the kernel does (fake_v4l2)."""

from __future__ import annotations

import errno
import time

import cv2
import numpy as np
import pytest
from linuxpy.video import raw

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.frame_source import SelfPacedSource, SourceOptions
from cmp_tactile_driver.parameters import CameraParameters
from cmp_tactile_driver.v4l2_source import V4L2Source

WIDTH, HEIGHT = 64, 48


@pytest.fixture
def open_source(small_sensor):
    """Opens a source with short times; closes it after the test."""
    opened = []

    def make(device="CAM1", frame_rate=0.0, **camera):
        times = {"frame_timeout": 0.15, "reconnect_delay": 0.02, "reconnect_delay_max": 0.08}
        settings = CameraParameters(**{"device": device, **times, **camera})
        options = SourceOptions("", small_sensor, frame_rate, camera=settings)
        opened.append(V4L2Source(options))
        return opened[-1]

    yield make
    for source in opened:
        source.close()


def _poll_until(source, condition, timeout_s=10.0):
    """The frames that came until then."""
    frames, end = [], time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, f"in vain; health: {source.health}"
        frame = source.poll(0.01)
        if frame is not None:
            frames.append(frame)
    return frames


def _grey(frames):
    return frames[0].tobytes()


@pytest.fixture
def picture(bags):
    return bags.frames(1, HEIGHT, WIDTH)[0]


@pytest.mark.parametrize(
    "device", ["CAM1", "usb-1-2-video-index0", "by-id/usb-Tactile_CAM1-video-index0", "video0", "/"]
)
def test_a_camera_is_found_by_serial_link_and_path(open_source, kernel, fake, picture, device):
    camera = fake.FakeCamera()
    node = kernel.plug(camera)
    source = open_source(str(node) if device == "/" else device)
    assert isinstance(source, SelfPacedSource)
    source.start()
    before = time.monotonic_ns()
    camera.give(picture.tobytes())
    frame = source.poll(1.0)
    assert np.array_equal(frame.image, picture)
    assert before - 1000 <= frame.monotonic_ns <= time.monotonic_ns()
    assert source.diagnostics["stamps"] == "start of exposure"
    assert source.diagnostics["serial"] == "CAM1"
    assert source.name == f"{node} (Tactile: Camera, serial CAM1, usb-1-2-video-index0)"
    assert (source.frame_rate, source.health.problem) == (60.0, "")
