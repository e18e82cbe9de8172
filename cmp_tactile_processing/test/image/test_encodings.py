"""What other makes of cameras send is read, or the field that is wrong is named.

Public reports, each tried here:
- ethz-asl/okvis_ros 20 (mono16 of the TUM dataset read as bytes): read, scaled by the bits used.
- ethz-asl/hand_eye_calibration 72 (10 bits in 16 become black): 10 bits reach from 0 to 255.
- ros-perception/vision_opencv 175, image_pipeline 314 (8UC1 and 16UC1 of RealSense): read.
- leggedrobotics/darknet_ros 336 (bgra8, rgba8, mono16 refused): read.
- voxel51/fiftyone 7961 (12 bits in 16, scaled by 65535, are black; by the maximum, they flicker):
  one scale for a stream, which never becomes smaller again.
- dganbold/raspicam_node 4 (more than height x step bytes), ros-perception/vision_opencv 27 (padded
  rows): read, every encoding.
- oxipng/oxipng 508, ruffle-rs/ruffle 6726 (16 bits to 8): alpha of 16 bits made images of 12 dark.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.image.encodings import (
    ENCODINGS,
    BitDepth,
    decode_compressed,
    decode_image,
    decode_raw,
)

WIDTH, HEIGHT = 16, 12
RED, GREEN, BLUE = 210, 120, 40
# OpenCV's weights of red, green and blue (ITU-R BT.601).
LUMINANCE = 0.299 * RED + 0.587 * GREEN + 0.114 * BLUE
# Limited-range YUV, both ways, in grey levels.
YUV_TOLERANCE = 3
# Of 16 bits to 8, with a factor in single precision, in grey levels.
ROUNDING = 0.501
FLOATS = cv2.imencode(".tiff", np.full((4, 4), 1000, np.float32))[1].tobytes()


def _packed(encoding: str) -> np.ndarray:
    """Rows of one colour, (HEIGHT, samples), as the names of the encodings say."""
    channels = {"r": RED, "g": GREEN, "b": BLUE, "a": 255}
    order = encoding.rstrip("0123456789") if encoding[0] in "rb" else "bgra"[: int(encoding[-1])]
    pixel = [channels[letter] for letter in order]
    deep = "16" in encoding
    # 16 bits of which 12 are used.
    values = np.array(pixel) * (16 if deep else 1) + (15 if deep else 0)
    if deep:
        values[values > 4000] = 65535  # alpha
    return np.tile(values, (HEIGHT, WIDTH)).astype("<u2" if deep else np.uint8)


def _mosaic(order: str) -> np.ndarray:
    channels = {"r": RED, "g": GREEN, "b": BLUE}
    cell = np.array([channels[letter] for letter in order]).reshape(2, 2)
    return np.tile(cell, (HEIGHT // 2, WIDTH // 2)).astype(np.uint8)


def _decode(rows: np.ndarray, encoding: str, **options) -> np.ndarray:
    rows = np.ascontiguousarray(rows)
    data = rows.view(np.uint8).ravel()
    step = options.pop("step", rows[0].nbytes)
    return decode_raw((WIDTH, HEIGHT), encoding, step, data, **options)


@pytest.mark.parametrize(
    "encoding",
    [f"{kind}{bits}" for kind in ("bgr", "rgb", "bgra", "rgba") for bits in (8, 16)]
    + ["8UC3", "8UC4", "16UC3", "16UC4"],
)
def test_the_order_of_the_channels(encoding):
    found = _decode(_packed(encoding), encoding)
    assert found.shape == (HEIGHT, WIDTH, 3)
    # 12 bits to 8 are rounded.
    assert np.abs(found.astype(int) - (BLUE, GREEN, RED)).max() <= 1


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaics(order, bits):
    mosaic = _mosaic(order)
    rows = mosaic if bits == 8 else mosaic.astype("<u2") * 16 + 15
    colour = _decode(rows, f"bayer_{order}{bits}")
    assert np.abs(colour.astype(int) - (BLUE, GREEN, RED)).max() <= 1
    grey = _decode(rows, f"bayer_{order}{bits}", luminance=True)
    assert grey.shape == (HEIGHT, WIDTH)
    assert np.abs(grey - LUMINANCE).max() <= 1.5


def _yuv() -> tuple[np.ndarray, int, int]:
    """Random luminance in limited range; chroma of one colour."""
    luma = np.random.default_rng(4).integers(16, 236, (HEIGHT, WIDTH), np.uint8)
    return luma, 90, 170


def _yuv_rows(encoding: str) -> np.ndarray:
    luma, u, v = _yuv()
    if encoding in ("yuyv", "yuv422_yuy2", "uyvy", "yuv422"):
        chroma = np.tile(np.array([u, v], np.uint8), (HEIGHT, WIDTH // 2))
        pair = (luma, chroma) if encoding.startswith(("yuyv", "yuv422_")) else (chroma, luma)
        return np.stack(pair, axis=-1).reshape(HEIGHT, -1)
    pair = (v, u) if encoding == "nv21" else (u, v)
    lines = 2 * HEIGHT if encoding == "nv24" else HEIGHT // 2
    chroma = np.tile(np.array(pair, np.uint8), (lines, WIDTH // 2))
    return np.concatenate([luma, chroma])


@pytest.mark.parametrize(
    "encoding", ["yuyv", "yuv422_yuy2", "uyvy", "yuv422", "nv12", "nv21", "nv24"]
)
def test_yuv(encoding):
    luma, u, v = _yuv()
    rows = _yuv_rows(encoding)
    np.testing.assert_array_equal(_decode(rows, encoding, luminance=True), luma)
    # ITU-R BT.601, limited range.
    bright = 1.164 * (luma.astype(float) - 16)
    bgr = np.stack(
        [
            bright + 2.018 * (u - 128),
            bright - 0.813 * (v - 128) - 0.391 * (u - 128),
            bright + 1.596 * (v - 128),
        ],
        axis=-1,
    )
    found = _decode(rows, encoding)
    assert np.abs(found - np.clip(bgr, 0, 255)).max() <= YUV_TOLERANCE


def test_every_encoding_takes_padded_rows_and_a_longer_buffer():
    rng = np.random.default_rng(5)
    for encoding, layout in ENCODINGS.items():
        lines, least = round(HEIGHT * layout.planes), WIDTH * layout.pixel_bytes
        rows = rng.integers(0, 256, (lines, least), np.uint8)
        expected = _decode(rows, encoding)
        data = np.append(np.pad(rows, ((0, 0), (0, 3))).ravel(), np.zeros(99, np.uint8))
        found = decode_raw((WIDTH, HEIGHT), encoding, least + 3, data)
        np.testing.assert_array_equal(found, expected, err_msg=encoding)


@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
@pytest.mark.parametrize("big_endian", [False, True])
def test_full_16_bits_are_scaled_as_cv_bridge_does(encoding, big_endian):
    deep = np.random.default_rng(6).integers(0, 65536, (HEIGHT, WIDTH), np.uint16)
    sent = deep.astype(">u2" if big_endian else "<u2")
    found = _decode(sent, encoding, big_endian=big_endian)
    assert np.abs(found - deep / 257).max() <= ROUNDING


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_the_scale_is_that_of_the_bits_that_are_used(bits):
    ramp = np.linspace(0, 2**bits - 1, WIDTH * HEIGHT).round().astype(np.uint16)
    found = _decode(ramp.reshape(HEIGHT, WIDTH), "mono16").ravel()
    assert np.abs(found - ramp * (255 / (2**bits - 1))).max() <= ROUNDING


@pytest.mark.parametrize(
    ("frames", "ahead", "times_said"),
    [
        # It stays where frames are darker.
        ([(4000, 12), (900, 12), (30, 12), (4095, 12), (2100, 12)], None, 1),
        # What is ahead sets that of a dark beginning; what is brighter is not cut off.
        ([(300, 12)], 12, 1),
        ([(900, 10), (3000, 12), (900, 12)], None, 2),
    ],
)
def test_a_stream_has_one_scale_which_is_said(frames, ahead, times_said):
    said: list[str] = []
    depth = BitDepth("/cam/image_raw", said.append, *([lambda: ahead] if ahead else []))
    for largest, bits in frames:
        found = _decode(np.full((HEIGHT, WIDTH), largest, np.uint16), "mono16", depth=depth)
        assert np.abs(found - largest * (255 / (2**bits - 1))).max() <= ROUNDING
        assert depth.bits == bits
    assert len(said) == times_said
    assert "/cam/image_raw" in said[-1]
    assert "12 of 16 bits" in said[-1]


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_files_of_16_bits(suffix):
    deep = np.random.default_rng(8).integers(0, 4096, (HEIGHT, WIDTH), np.uint16)
    content = cv2.imencode(suffix, deep)[1].ravel()
    assert np.abs(decode_image(content, "a file") - deep * (255 / 4095)).max() <= ROUNDING
    alpha = np.dstack([deep, deep, deep, np.full_like(deep, 65535)])
    content = cv2.imencode(suffix, alpha)[1].ravel()
    found = decode_image(content, "a file")
    assert np.abs(found - alpha[..., :3] * (255 / 4095)).max() <= ROUNDING


def _encoded(suffix: str, image: np.ndarray) -> np.ndarray:
    quality = [cv2.IMWRITE_JPEG_QUALITY, 100] if suffix == ".jpg" else []
    return cv2.imencode(suffix, image, quality)[1].ravel()


@pytest.mark.parametrize(
    "text", ["rgb8; jpeg compressed bgr8", "rgba8; jpeg compressed bgr8", "bgr8; jpeg", "jpeg"]
)
def test_compressed_colours(text):
    bgr = np.tile(np.array([BLUE, GREEN, RED], np.uint8), (HEIGHT, WIDTH, 1))
    found = decode_compressed(text, _encoded(".jpg", bgr))
    assert np.abs(found.astype(int) - bgr).max() <= YUV_TOLERANCE
    np.testing.assert_array_equal(decode_compressed("png", _encoded(".png", bgr)), bgr)
    swapped = np.ascontiguousarray(bgr[..., ::-1])
    found = decode_compressed("rgb8; png compressed rgb8", _encoded(".png", swapped))
    np.testing.assert_array_equal(found, bgr)


@pytest.mark.parametrize("text", ["", "bgr8", "mjpg", "MJPEG; compressed", "image/x-any"])
def test_a_format_that_names_no_image_is_taken_by_the_first_bytes(text):
    """Reports: ros-perception/vision_opencv 382, UbiquityRobotics/raspicam_node 96."""
    bgr = np.random.default_rng(4).integers(0, 256, (8, 6, 3), np.uint8)
    np.testing.assert_array_equal(decode_compressed(text, _encoded(".png", bgr)), bgr)
    jpeg = _encoded(".jpg", bgr)
    np.testing.assert_array_equal(decode_compressed(text, jpeg), decode_compressed("jpeg", jpeg))


def test_compressed_16_bits_and_mosaics():
    deep = np.random.default_rng(9).integers(0, 4096, (HEIGHT, WIDTH), np.uint16)
    png = _encoded(".png", deep)
    for text in ("16UC1; png compressed ", "mono16; png compressed mono16"):
        found = decode_compressed(text, png, BitDepth(say=lambda _: None))
        assert np.abs(found - deep * (255 / 4095)).max() <= ROUNDING
    mosaic = _encoded(".png", _mosaic("grbg"))
    found = decode_compressed("bayer_grbg8; png compressed ", mosaic)
    assert np.abs(found.astype(int) - (BLUE, GREEN, RED)).max() <= 1


@pytest.mark.parametrize("encoding", ["32FC1", "16SC1", "theora", "MONO8", ""])
def test_what_is_no_image_is_refused(encoding):
    with pytest.raises(FrameError, match=r"encoding: found .*expected mono8, bgr8"):
        decode_raw((WIDTH, HEIGHT), encoding, 64, np.zeros(9999, np.uint8))


def test_planes_with_padded_rows_and_with_the_step_of_all_planes():
    luma, _, _ = _yuv()
    rows = _yuv_rows("nv12")
    padded = np.pad(rows, ((0, 0), (0, 5)))
    np.testing.assert_array_equal(_decode(padded, "nv12"), _decode(rows, "nv12"))
    found = _decode(rows, "nv12", step=2 * WIDTH, luminance=True)
    np.testing.assert_array_equal(found, luma)


def test_a_name_without_end_is_cut_in_the_error():
    with pytest.raises(FrameError, match=r"encoding: found 'xx.*\.\.\., exp") as raised:
        decode_raw((8, 6), "x" * 10**6, 8, np.zeros(48, np.uint8))
    with pytest.raises(FrameError, match=r"format: found 'xx.*\.\.\., exp") as compressed:
        decode_compressed("x" * 10**6, np.zeros(48, np.uint8))
    assert max(len(str(raised.value)), len(str(compressed.value))) < 300


@pytest.mark.parametrize(
    ("size", "encoding", "step", "length", "message"),
    [
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


@pytest.mark.parametrize(
    ("format_text", "data", "message"),
    [
        ("mono8; theora compressed", b"abc", "format: found 'mono8; theora compressed'"),
        ("16UC1; compressedDepth png", b"abc", "format: found '16UC1; compressedDepth png'"),
        ("h264", b"\0\0\0\1\x67", "format: found 'h264', expected png or jpeg"),
        ("png", b"abc", "data: found 3 bytes that are not a readable image"),
        ("jpeg", b"", "data: found 0 bytes"),
        ("png", FLOATS, "found float32 pixels, expected uint8 or uint16"),
    ],
)
def test_unusable_compressed_data_are_named(format_text, data, message):
    with pytest.raises(FrameError, match=message):
        decode_compressed(format_text, np.frombuffer(data, np.uint8))
