"""A video gives its frames; what is missing at its end is counted."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.files import VideoFile

FRAMES = 10
# Motion JPEG of smooth images, in grey levels.
JPEG_TOLERANCE = 6


@pytest.fixture
def video(tmp_path):
    """Ten grey ramps that get brighter, at 25 Hz."""
    path = tmp_path / "ramp.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    assert writer.isOpened()
    for number in range(FRAMES):
        writer.write(_ramp(number))
    writer.release()
    return path


def _ramp(number):
    row = np.linspace(0, 100, 64) + 10 * number
    return np.repeat(np.tile(row, (48, 1))[..., None], 3, axis=2).astype(np.uint8)


def _read_all(source):
    found = []
    while (frame := source.read()) is not None:
        found.append(frame)
    return found


def test_frames_and_rate(video):
    source = VideoFile(video)
    assert source.frame_rate == 25.0
    found = _read_all(source)
    assert len(found) == FRAMES
    assert source.read() is None
    assert source.health.bad_frames == 0
    for number, frame in enumerate(found):
        assert frame.encoding == "bgr8"
        assert np.abs(frame.image.astype(int) - _ramp(number)).max() <= JPEG_TOLERANCE
    source.close()


def test_given_rate_and_loop(video):
    source = VideoFile(video, 60.0, loop=True)
    assert source.frame_rate == 60.0
    images = [source.read().image for _ in range(2 * FRAMES)]
    assert all(np.array_equal(a, b) for a, b in zip(images[:FRAMES], images[FRAMES:], strict=True))
    source.close()


def test_missing_and_undecodable_file(tmp_path):
    with pytest.raises(FrameSourceError, match=r"none.avi: found no such file"):
        VideoFile(tmp_path / "none.avi")
    (tmp_path / "bad.avi").write_bytes(b"not a video" * 100)
    with pytest.raises(FrameSourceError, match=r"bad.avi: found 1100 bytes, expected a video"):
        VideoFile(tmp_path / "bad.avi")


def test_truncated_end_is_counted(tmp_path):
    path = tmp_path / "noise.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (320, 240))
    generator = np.random.default_rng(5)
    for _ in range(FRAMES):
        writer.write(generator.integers(0, 256, (240, 320, 3), np.uint8))
    writer.release()
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 6 // 10])
    source = VideoFile(path)
    count = len(_read_all(source))
    assert 0 < count < FRAMES
    assert source.health.bad_frames == FRAMES - count
    assert f"{count} of {FRAMES} frames, the rest is damaged" in source.health.problem


def test_wrong_size_is_named(video):
    with pytest.raises(FrameSourceError, match="found 64 x 48 px, expected 1024 x 768 px"):
        VideoFile(video, expected_size=(1024, 768)).read()
