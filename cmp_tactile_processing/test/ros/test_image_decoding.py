"""Pixels come out as they went in, and what cannot be decoded says which field is wrong."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.image.compressed import decode_compressed, decode_image
from cmp_tactile_processing.image.raw import decode_raw

# Full-range to limited-range rounding of YUV, both ways, in grey levels.
YUV_TOLERANCE = 3


def _colour(height: int = 6, width: int = 8) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (height, width, 3), np.uint8)


def test_mono8_with_padded_rows():
    rows = np.arange(5 * 10, dtype=np.uint8).reshape(5, 10)
    assert np.array_equal(decode_raw((7, 5), "mono8", 10, rows.ravel()), rows[:, :7])


def test_colour_order():
    bgr = _colour()
    rgb = np.ascontiguousarray(bgr[..., ::-1])
    assert np.array_equal(decode_raw((8, 6), "bgr8", 24, bgr.ravel()), bgr)
    assert np.array_equal(decode_raw((8, 6), "rgb8", 24, rgb.ravel()), bgr)


@pytest.mark.parametrize("name", ["yuv422_yuy2", "yuyv"])
def test_yuyv_is_read_as_luma_first(name):
    # Equal neighbours: the chroma that two pixels share is then exact.
    bgr = np.repeat(_colour(6, 4), 2, axis=1)
    yuv = cv2.cvtColor(bgr, cv2.COLOR_BGR2YUV_YUY2)
    found = decode_raw((8, 6), name, 16, yuv.ravel())
    assert found.shape == (6, 8, 3)
    assert np.abs(found.astype(int) - bgr).max() <= YUV_TOLERANCE


def test_a_name_without_end_is_cut_in_the_error():
    with pytest.raises(FrameError, match=r"encoding: found 'xx.*\.\.\., exp") as raised:
        decode_raw((8, 6), "x" * 10**6, 8, np.zeros(48, np.uint8))
    with pytest.raises(FrameError, match=r"format: found 'xx.*\.\.\., exp") as compressed:
        decode_compressed("x" * 10**6, np.zeros(48, np.uint8))
    assert max(len(str(raised.value)), len(str(compressed.value))) < 300


@pytest.mark.parametrize(
    ("size", "encoding", "step", "length", "message"),
    [
        ((8, 6), "32FC1", 32, 192, "encoding: found '32FC1', expected mono8, bgr8"),
        ((0, 6), "mono8", 8, 48, "width, height: found 0 x 6"),
        ((70000, 60000), "mono8", 70000, 48, "width, height: found 70000 x 60000"),
        ((8, 6), "bgr8", 8, 48, "step: found 8 bytes, expected at least 24 for bgr8"),
        ((8, 6), "mono8", 8, 47, r"data: found 47 bytes, expected 48 \(6 rows of 8\)"),
        ((8, 6), "mono16", 16, 95, r"data: found 95 bytes, expected 96"),
        ((8, 6), "nv12", 8, 71, r"data: found 71 bytes, expected 72 \(9 rows of 8\)"),
        ((7, 6), "yuyv", 14, 84, "width: found 7 px, expected an even number"),
    ],
)
def test_wrong_fields_are_named(size, encoding, step, length, message):
    with pytest.raises(FrameError, match=message):
        decode_raw(size, encoding, step, np.zeros(length, np.uint8))


@pytest.mark.parametrize("behind", [1, 8, 4096])
def test_bytes_behind_the_image_are_cut(behind):
    """A driver sends its whole buffer, with padding in each row and behind the image.

    Reports: dganbold/raspicam_node 4 (more than height x step bytes), ros-perception/vision_opencv
    27 (padded rows); tried: read.
    """
    image = np.arange(48, dtype=np.uint8).reshape(6, 8)
    padded = np.pad(image, ((0, 0), (0, 2)), constant_values=7).ravel()
    data = np.concatenate([padded, np.full(behind, 9, np.uint8)])
    assert np.array_equal(decode_raw((8, 6), "mono8", 10, data), image)


def test_compressed_png_is_exact():
    grey = _colour()[..., 0]
    data = cv2.imencode(".png", grey)[1].ravel()
    assert np.array_equal(decode_compressed("mono8; png compressed ", data), grey)
    bgr = _colour()
    data = cv2.imencode(".png", bgr)[1].ravel()
    assert np.array_equal(decode_compressed("png", data), bgr)


@pytest.mark.parametrize(
    ("format_text", "data", "message"),
    [
        ("mono8; theora compressed", b"abc", "format: found 'mono8; theora compressed'"),
        ("16UC1; compressedDepth png", b"abc", "format: found '16UC1; compressedDepth png'"),
        ("png", b"abc", "data: found 3 bytes that are no readable image"),
        ("jpeg", b"", "data: found 0 bytes"),
    ],
)
def test_unusable_compressed_data_are_named(format_text, data, message):
    with pytest.raises(FrameError, match=message):
        decode_compressed(format_text, np.frombuffer(data, np.uint8))


def test_floating_point_is_refused():
    data = cv2.imencode(".tiff", np.full((4, 4), 1000, np.float32))[1].ravel()
    with pytest.raises(FrameError, match="found float32 pixels, expected uint8 or uint16"):
        decode_image(data, "data")
