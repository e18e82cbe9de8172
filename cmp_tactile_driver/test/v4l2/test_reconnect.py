"""A camera that goes away while it is read: unplugged, stalled, failing (fake_v4l2)."""

import errno
import threading
import time

import numpy as np
import pytest
from fake_v4l2 import webcam_controls
from linuxpy.video import raw
from waiting import wait_until

from cmp_tactile_driver.sources.capture import Capture, CaptureState
from cmp_tactile_processing.errors import FrameSourceError


def _poll_until(source, condition):
    """The frames that came until then."""
    frames = []
    wait_until(condition, "the source", step=lambda: frames.append(source.poll(0.01)))
    return [frame for frame in frames if frame is not None]


def test_a_camera_is_found_again_at_another_number_with_its_controls(
    open_source, plug, kernel, picture
):
    camera = plug()
    source = open_source("video0")
    source.keep_controls()
    source.set_controls({"auto_exposure": 1, "exposure_time_absolute": 40, "gain": 7})
    source.start()
    camera.give(picture.tobytes())
    assert source.poll(20.0) is not None
    kernel.unplug(camera)
    _poll_until(source, lambda: source.health.silent)
    assert "video0: next frame: found it unplugged, expected a camera" in source.health.problem
    with pytest.raises(FrameSourceError, match="unplugged"):
        source.set_controls({"gain": 8})
    # Another camera takes its name; it is not taken for it.
    plug("CAM2", number=0, port="1-7")
    _poll_until(source, lambda: "expected the camera with serial CAM1" in source.health.problem)
    camera.controls = webcam_controls()
    kernel.plug(camera, number=3, port="1-4")
    _poll_until(source, lambda: camera.streaming)
    found = {item.name: item.value for item in camera.controls}
    assert (found["Auto Exposure"], found["Exposure Time, Absolute"], found["Gain"]) == (1, 40, 7)
    assert source.health.silent, "it is back once it gives a frame"
    camera.give(picture.tobytes())
    assert source.poll(20.0).origin.endswith("video3 frame 0")
    assert (source.health.silent, source.health.problem) == (False, "")
    assert source.diagnostics["reconnects"] == 1
    assert source.health.dropped_frames == 0


def test_many_unpluggings_leave_no_open_files_or_mapped_buffers(
    handles, open_source, plug, kernel, picture
):
    camera = plug()
    closed = handles()
    source = open_source()
    source.start()
    opened = handles()
    for number in range(1, 21):
        kernel.unplug(camera)
        _poll_until(source, lambda: source.health.silent)
        kernel.plug(camera, number=number % 3)
        _poll_until(source, lambda: camera.streaming)
        camera.give(picture.tobytes())
        assert source.poll(20.0) is not None
    assert handles() == opened
    source.close()
    assert handles() == closed


@pytest.mark.parametrize("number", [errno.EIO, errno.EPROTO])
def test_a_failing_device_is_opened_again(open_source, plug, picture, number):
    camera = plug()
    source = open_source()
    source.start()
    camera.fault[raw.IOC.DQBUF] = number
    _poll_until(source, lambda: source.health.silent)
    assert "next frame: found the error" in source.health.problem
    camera.fault.clear()
    _poll_until(source, lambda: camera.streaming)
    camera.give(picture.tobytes())
    assert source.poll(20.0) is not None
    assert source.health.problem == ""


def test_a_camera_without_frames_is_reported_and_opened_less_and_less_often(
    open_source, plug, picture
):
    camera = plug()
    source = open_source(frame_timeout=0.05)
    source.start()
    _poll_until(source, lambda: source.health.silent)
    assert "found no frame for 0.05 s, expected 60 Hz" in source.health.problem
    begin, before = time.monotonic(), source.diagnostics["reconnects"]
    _poll_until(source, lambda: source.diagnostics["reconnects"] >= before + 4)
    # Four waits of 0.02, 0.04, 0.08 and 0.08 s, three silences of 0.05 s between them: 0.37 s.
    # With the first wait each time it would be 0.23 s.
    assert time.monotonic() - begin >= 0.33
    _poll_until(source, lambda: camera.streaming)
    camera.give(picture.tobytes())
    _poll_until(source, lambda: not source.health.silent)


def test_reading_without_ros_goes_on_until_it_is_closed(open_source, plug, picture):
    camera = plug()
    source = open_source()
    giver = threading.Timer(0.05, camera.give, [picture.tobytes()])
    giver.start()
    assert np.array_equal(source.read().image, picture)
    source.close()
    with pytest.raises(FrameSourceError, match="is closed"):
        source.read()


def test_a_capture_can_be_stopped_while_the_camera_is_away_and_goes_on_later(
    open_source, plug, kernel, picture
):
    camera = plug()
    source = open_source(reconnect_delay=30.0)
    frames = []
    capture = Capture(source, frames.append)
    capture.start()
    kernel.unplug(camera)
    wait_until(lambda: source.health.silent, "the loss")
    capture.stop()
    assert "capture" not in [thread.name for thread in threading.enumerate()]
    assert (capture.state, capture.failure) == (CaptureState.IDLE, "")
    capture.start()
    wait_until(lambda: capture.state is CaptureState.RUNNING, "the start")
    source.close()
    capture.stop()
