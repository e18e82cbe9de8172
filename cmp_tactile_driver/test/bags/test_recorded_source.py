"""A bag as the source of the camera driver: its frames, its rate, and what is no such bag."""

from dataclasses import replace

import made_bags
import numpy as np
import pytest

from cmp_tactile_driver.bags.recording import recorded_source
from cmp_tactile_driver.sources.frames import SourceOptions
from cmp_tactile_processing.errors import FrameSourceError


@pytest.fixture
def image_bag(tmp_path, frames):
    """The frames alone, at 20 Hz, and one of another size."""
    messages = made_bags.images([np.zeros((8, 8), np.uint8), *frames])
    return made_bags.write(tmp_path / "images_bag", {"/rig/image_raw": messages})


def test_frames_of_a_bag_come_in_order_at_the_recorded_rate(image_bag, small_sensor, frames):
    source = recorded_source(SourceOptions(str(image_bag), small_sensor))
    assert source.frame_rate == pytest.approx(20.0)
    for frame in frames:
        read = source.read()
        assert np.array_equal(read.image, frame)
        assert read.monotonic_ns is None
    assert source.read() is None
    assert source.health.bad_frames == 1
    assert "found 8 x 8 px, expected 64 x 48 px" in source.health.problem
    source.close()


def test_a_bag_begins_again_and_goes_on_counting(image_bag, small_sensor, frames):
    source = recorded_source(SourceOptions(str(image_bag), small_sensor, 50.0, loop=True))
    assert source.frame_rate == 50.0
    read = [source.read().image for _ in range(2 * len(frames))]
    assert np.array_equal(read[len(frames)], frames[0])
    assert source.health.bad_frames == 2


def test_images_begin_again_and_go_on_counting(image_folder, small_sensor, frames):
    (image_folder / "0.png").write_bytes(b"")
    source = recorded_source(SourceOptions(str(image_folder), small_sensor, loop=True))
    assert source.frame_rate == 30.0
    read = [source.read().image for _ in range(2 * (len(frames) - 1))]
    assert all(np.array_equal(a, b) for a, b in zip(read, 2 * frames[1:], strict=True))
    assert source.health.bad_frames == 2


def test_a_bag_of_another_camera_is_refused(frame_bag, small_sensor):
    with pytest.raises(FrameSourceError, match=r"bag: /rig/camera_info: K: found .*, expected"):
        recorded_source(SourceOptions(str(frame_bag), small_sensor))


def test_a_bag_without_frames_of_the_size_is_refused(image_bag, small_sensor):
    image = replace(small_sensor.image, width=100)
    sensor = replace(small_sensor, image=image)
    with pytest.raises(FrameSourceError, match=r"no frame can be used: .*expected 100 x 48 px"):
        recorded_source(SourceOptions(str(image_bag), sensor))
    with pytest.raises(FrameSourceError, match="nowhere"):
        recorded_source(SourceOptions("/nowhere/bag", sensor))
