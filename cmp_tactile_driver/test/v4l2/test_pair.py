"""Two cameras as one source: pairs by time, placed where the description has its views."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_driver.sources.frames import Frame, SelfPacedSource, SourceOptions
from cmp_tactile_driver.sources.parameters import CameraParameters
from cmp_tactile_driver.v4l2.pair import CameraPair, open_cameras
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.sensor.parts import Roi

MS = 10**6


@pytest.fixture
def wide_sensor(small_sensor):
    """A frame of 128 x 48 px, in which the right view lies on the left."""
    rois = {"left": Roi(64, 0, 64, 48), "right": Roi(0, 0, 64, 48)}
    views = {name: replace(view, roi=rois[name]) for name, view in small_sensor.views.items()}
    image = replace(small_sensor.image, width=128, height=48)
    return replace(small_sensor, image=image, views=views)


@pytest.fixture
def cameras(plug):
    return plug("CAM1"), plug("CAM2", number=1, port="1-3")


@pytest.fixture
def open_pair(cameras, wide_sensor):
    opened = []

    def make(device="CAM1,CAM2", **settings):
        options = SourceOptions("", wide_sensor, camera=CameraParameters(device, **settings))
        opened.append(open_cameras(options))
        return opened[-1]

    yield make
    for source in opened:
        source.close()


def test_frames_of_one_time_lie_where_the_views_are(open_pair, cameras, picture):
    # As far apart as this machine is slow.
    pair = open_pair(pair_tolerance=1.0)
    assert isinstance(pair, CameraPair)
    assert isinstance(pair, SelfPacedSource)
    pair.start()
    for camera, image in zip(cameras, (picture, 255 - picture), strict=True):
        camera.give(image.tobytes())
    frame = pair.poll(20.0)
    assert np.array_equal(frame.image[:, 64:], picture)
    assert np.array_equal(frame.image[:, :64], 255 - picture)
    assert pair.health.dropped_frames == 0
    assert {"left serial", "right serial"} <= set(pair.diagnostics)
    assert pair.poll(0.0) is None


def test_reading_without_ros_starts_the_cameras_and_ends_with_them(open_pair, cameras, picture):
    def give():
        while not all(camera.streaming for camera in cameras):
            time.sleep(0.005)
        for camera in cameras:
            camera.give(picture.tobytes())

    # Cameras that are silent for so long are opened again, and started by that.
    pair = open_pair(pair_tolerance=1.0, frame_timeout=20.0)
    threading.Thread(target=give, daemon=True).start()
    assert np.array_equal(pair.read().image[:, :64], picture)
    assert pair.diagnostics["left reconnects"] == 0
    pair.close()
    with pytest.raises(FrameSourceError, match="is closed"):
        pair.read()


def test_a_frame_without_a_partner_is_dropped_and_reported(open_pair, picture, monkeypatch):
    """The left camera misses a frame: the pairs after it are of one time again."""
    pair = open_pair(pair_tolerance=0.004)
    times = {"left": [0, 40, 60], "right": [1, 21, 42, 63]}
    for source, view in zip(pair._sources, times, strict=True):
        frames = iter([Frame(picture, view, monotonic_ns=t * MS) for t in times[view]])
        monkeypatch.setattr(source, "poll", lambda _timeout, frames=frames: next(frames, None))
    found = [pair.poll(0.0) for _ in range(5)]
    assert [f and f.monotonic_ns / MS for f in found] == [0.5, None, 41.0, 61.5, None]
    assert pair.health.dropped_frames == 1
    assert pair.diagnostics["frames without partner"] == 1


def test_frames_that_are_always_apart_are_reported_with_the_difference(
    open_pair, picture, monkeypatch
):
    pair = open_pair(pair_tolerance=0.004)
    for source, time_ms in zip(pair._sources, (0, 9), strict=True):
        frame = Frame(picture, "", monotonic_ns=time_ms * MS)
        monkeypatch.setattr(source, "poll", lambda _timeout, frame=frame: frame)
    assert pair.poll(0.0) is None
    assert (
        "found frames that are 9.0 ms apart, expected at most 4 ms (pair_tolerance)"
        in pair.health.problem
    )


@pytest.mark.parametrize("device", ["CAM1,", "CAM1,CAM1", "CAM1,CAM2,CAM3"])
def test_what_is_no_pair_is_refused(open_pair, device):
    with pytest.raises(FrameSourceError, match="expected one camera, or two different ones"):
        open_pair(device)
