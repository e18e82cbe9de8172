"""A folder of images is read in natural order; bad images are skipped, counted and named."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.files import ImageFolder


def _read_all(source):
    found = []
    while (frame := source.read()) is not None:
        found.append(frame)
    return found


def test_natural_order_and_pixels(image_folder, frames):
    found = _read_all(ImageFolder(image_folder, 30.0))
    assert [frame.origin for frame in found] == [f"{n}.png" for n in range(len(frames))]
    assert all(np.array_equal(a.image, b) for a, b in zip(found, frames, strict=True))
    assert {frame.encoding for frame in found} == {"mono8"}


def test_colour_stays_colour(tmp_path):
    bgr = np.random.default_rng(1).integers(0, 256, (6, 8, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "a.PNG"), bgr)
    frame = ImageFolder(tmp_path, 30.0).read()
    assert frame is not None
    assert frame.encoding == "bgr8"
    assert np.array_equal(frame.image, bgr)


def test_loop_begins_again(image_folder, frames):
    source = ImageFolder(image_folder, 30.0, loop=True)
    found = [source.read() for _ in range(2 * len(frames))]
    assert [f.origin for f in found[: len(frames)]] == [f.origin for f in found[len(frames) :]]


def test_missing_and_empty_folders(tmp_path):
    with pytest.raises(FrameSourceError, match="nowhere: found no such folder"):
        ImageFolder(tmp_path / "nowhere", 30.0)
    (tmp_path / "notes.txt").write_text("no image")
    with pytest.raises(FrameSourceError, match=r"found no image among 1 entries, expected \.bmp"):
        ImageFolder(tmp_path, 30.0)


@pytest.mark.parametrize("keep", [0, 100])
def test_bad_image_in_the_middle_is_skipped_and_named(image_folder, frames, keep):
    path = image_folder / "5.png"
    path.write_bytes(path.read_bytes()[:keep])
    source = ImageFolder(image_folder, 30.0)
    assert len(_read_all(source)) == len(frames) - 1
    assert source.health.bad_frames == 1
    assert f"{path}: found {keep} bytes that are no readable image" in source.health.problem


def test_changing_size_is_skipped_and_named(image_folder, frames):
    cv2.imwrite(str(image_folder / "5.png"), np.zeros((10, 20), np.uint8))
    source = ImageFolder(image_folder, 30.0)
    assert len(_read_all(source)) == len(frames) - 1
    assert "5.png: found 20 x 10 px, expected 64 x 48 px" in source.health.problem


def test_one_image_of_another_size_ends_no_loop(image_folder, frames):
    cv2.imwrite(str(image_folder / "0.png"), np.zeros((10, 20), np.uint8))
    source = ImageFolder(image_folder, 30.0, loop=True, expected_size=(64, 48))
    found = [source.read().origin for _ in range(4 * (len(frames) - 1))]
    assert found == 4 * [f"{n}.png" for n in range(1, len(frames))]
    assert source.health.bad_frames == 4


def test_nothing_of_the_expected_size(image_folder):
    source = ImageFolder(image_folder, 30.0, loop=True, expected_size=(1024, 768))
    with pytest.raises(
        FrameSourceError,
        match=r"none of the first 2 of 12 images is good.*found 64 x 48 px, expected 1024 x 768",
    ):
        source.read()
