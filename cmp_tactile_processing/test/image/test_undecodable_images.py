"""Compressed images are read, and what cannot be decoded says which field is wrong."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.image.encodings import decode_compressed, decode_image, decode_raw


def _colour(height: int = 6, width: int = 8) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (height, width, 3), np.uint8)


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
        ("png", b"abc", "data: found 3 bytes that are not a readable image"),
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
