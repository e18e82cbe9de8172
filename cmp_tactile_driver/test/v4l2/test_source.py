"""The source `v4l2`, by linuxpy, on cameras that answer as the kernel does (fake_v4l2)."""

import errno
import re
import struct
import time

import cv2
import made_bags
import numpy as np
import pytest
import simplejpeg
from linuxpy.video import raw

from cmp_tactile_driver.sources.frames import SelfPacedSource
from cmp_tactile_driver.v4l2.camera import PREFERENCE
from cmp_tactile_processing.errors import FrameSourceError

WIDTH, HEIGHT = 64, 48


@pytest.mark.parametrize(
    "device", ["CAM1", "usb-1-2-video-index0", "by-id/usb-Tactile_CAM1-video-index0", "video0", "/"]
)
def test_a_camera_is_found_by_serial_link_and_path(open_source, plug, picture, device):
    camera = plug()
    node = camera.node
    source = open_source(str(node) if device == "/" else device)
    assert isinstance(source, SelfPacedSource)
    source.start()
    before = time.monotonic_ns()
    camera.give(picture.tobytes())
    frame = source.poll(20.0)
    assert np.array_equal(frame.image, picture)
    assert before - 1000 <= frame.monotonic_ns <= time.monotonic_ns()
    assert source.diagnostics["stamps"] == "start of exposure"
    assert source.diagnostics["serial"] == "CAM1"
    assert source.name == f"{node} (Tactile: Camera, serial CAM1, usb-1-2-video-index0)"
    assert (source.frame_rate, source.health.problem) == (60.0, "")


def test_a_camera_that_repeats_one_image_is_reported(open_source, plug, picture):
    """The force would not change any more; tried: no word of it.

    Reports: bluecherrydvr/unity 124, roleoroleo/yi-hack-Allwinner-v2 61.
    """
    camera = plug()
    source = open_source()
    source.start()

    def problem_after(count: int, image) -> str:
        for _ in range(count):
            camera.give(image.tobytes())
            assert source.poll(20.0) is not None
        return source.health.problem

    for image in (picture, picture[::-1]):
        assert problem_after(10, image) == ""
    assert "found the same image 11 times" in problem_after(11, picture)


@pytest.mark.parametrize("extra_step", [0, 12])
@pytest.mark.parametrize("colour", [True, False])
def test_pixel_formats_with_padded_rows(open_source, plug, extra_step, colour):
    size = {(WIDTH, HEIGHT): (30,)}
    bgr = np.stack(made_bags.frames(3, HEIGHT, WIDTH), axis=2)
    yuyv = np.ascontiguousarray(bgr[..., :2])
    grey_of_bgr = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    for name, pixels, in_colour, in_grey in (
        ("GREY", bgr[..., 0], bgr[..., 0], bgr[..., 0]),
        ("BGR3", bgr, bgr, grey_of_bgr),
        ("RGB3", bgr[..., ::-1], bgr, grey_of_bgr),
        # Luminance is what was measured, also beyond the 16 to 235 that conversions keep.
        ("YUYV", yuyv, cv2.cvtColor(yuyv, cv2.COLOR_YUV2BGR_YUY2), yuyv[..., 0]),
    ):
        expected = in_colour if colour else in_grey
        rows = np.ascontiguousarray(pixels).reshape(HEIGHT, -1)
        padded = np.pad(rows, ((0, 0), (0, extra_step))).tobytes()
        number = PREFERENCE.index(name)
        camera = plug(name, {name: size}, number=number, port=f"1-{number}", extra_step=extra_step)
        source = open_source(device=name, pixel_format=name, colour=colour)
        source.start()
        camera.give(padded)
        assert np.array_equal(source.poll(20.0).image, expected), name


def _jpeg_of_size(jpeg: bytes, width: int, height: int) -> bytes:
    """With another size in its frame header, which is more than the decoder would take."""
    at = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:at] + struct.pack(">HH", height, width) + jpeg[at + 4 :]


def test_mjpg_is_decoded_and_a_broken_frame_is_counted_and_reported(open_source, plug, picture):
    smooth = cv2.GaussianBlur(picture, (0, 0), 3)
    jpeg = cv2.imencode(".jpg", smooth, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    camera = plug(modes={"MJPG": {(WIDTH, HEIGHT): (30,)}})
    source = open_source()
    source.start()
    other_size = cv2.imencode(".jpg", smooth[:40])[1].tobytes()
    for data, flags, reason in (
        (jpeg[: len(jpeg) // 2], 0, "damaged JPEG .*premature end"),
        (b"", 0, "found 0 bytes that are not a readable image"),
        (b"\xff\xd8 nothing \xff\xd9", 0, "not a readable image"),
        (_jpeg_of_size(jpeg, 65500, 65500), 0, "found 65500 x 65500 px, expected 64 x 48 px"),
        (jpeg[: jpeg.index(b"\xff\xc0")] + b"\xff\xd9", 0, "not a readable image"),
        (jpeg[:-200] + jpeg[-100:], 0, "damaged JPEG"),
        (b"\xff" * 5000 + b"\xff\xd9", 0, "not a readable image"),
        (other_size, 0, "found 64 x 40 px, expected 64 x 48 px"),
        (jpeg, raw.BufferFlag.ERROR, "marks as damaged"),
    ):
        before = source.health.bad_frames
        camera.give(data, flags=flags)
        assert source.poll(1.0) is None
        assert source.health.bad_frames == before + 1
        assert re.search(reason, source.health.problem)
        assert not source.health.silent
    camera.give(jpeg)
    frame = source.poll(20.0)
    # JPEG at quality 95, smooth noise, in grey values.
    assert np.abs(frame.image.astype(int) - smooth).max() <= 4
    assert source.health.dropped_frames == 0


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_of_another_size_is_never_decoded(
    open_source, plug, picture, progressive, monkeypatch
):
    """Its size is in the header, also behind segments and bytes that fill up."""
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive]
    jpeg = cv2.imencode(".jpg", picture, options)[1].tobytes()
    filled = jpeg[:2] + b"\xff\xe1\x00\x06\xff\xc0ab" + b"\xff" * 9 + jpeg[2:]
    camera = plug(modes={"MJPG": {(WIDTH, HEIGHT): (30,)}})
    source = open_source()
    source.start()
    camera.give(filled)
    assert source.poll(20.0).image.shape == (HEIGHT, WIDTH)
    decoded = []
    monkeypatch.setattr(simplejpeg, "decode_jpeg", lambda *given, **_: decoded.append(given))
    camera.give(cv2.imencode(".jpg", picture[:, :40], options)[1].tobytes())
    assert source.poll(1.0) is None
    assert "found 40 x 48 px, expected 64 x 48 px" in source.health.problem
    assert decoded == []


@pytest.mark.parametrize(
    ("rate", "chosen"), [(0.0, ("MJPG", 60.0)), (30.0, ("YUYV", 30.0)), (60.0, ("MJPG", 60.0))]
)
def test_auto_takes_the_rate_first_and_then_pixels_without_loss(open_source, plug, rate, chosen):
    size = (WIDTH, HEIGHT)
    modes = {"MJPG": {size: (30, 60)}, "YUYV": {size: (10, 30)}, "GREY": {(32, 24): (60,)}}
    plug(modes=modes)
    source = open_source(frame_rate=rate)
    assert source.frame_rate == chosen[1]
    assert source.diagnostics["mode"] == f"{chosen[0]} 64 x 48, {chosen[1]:g} Hz"


@pytest.mark.parametrize(
    ("modes", "wanted", "text"),
    [
        (
            {"MJPG": {(WIDTH, HEIGHT): (30,)}, "YUYV": {(WIDTH, HEIGHT): (30,)}},
            {"pixel_format": "GREY"},
            r"video0: pixel_format: found GREY, expected .*: MJPG, YUYV",
        ),
        (
            {"H264": {(WIDTH, HEIGHT): (30,)}},
            {},
            "pixel_format: found GREY, YUYV, BGR3, RGB3, MJPG, JPEG, expected .*: H264",
        ),
        (
            {"GREY": {(640, 480): (30,), (1280, 800): (30,)}, "MJPG": {(32, 24): (5,)}},
            {},
            "image size of .*: found 64 x 48 px, .*: GREY: 640 x 480, 1280 x 800; MJPG: 32 x 24",
        ),
        (
            {"GREY": {(WIDTH, HEIGHT): (30, 60)}, "MJPG": {(WIDTH, HEIGHT): (90,)}},
            {"frame_rate": 120.0},
            "frame_rate: found 120 Hz, .* at 64 x 48 px: GREY: 30, 60 Hz; MJPG: 90 Hz",
        ),
    ],
)
def test_what_a_camera_cannot_do_is_named_with_what_it_can(open_source, plug, modes, wanted, text):
    plug(modes=modes)
    with pytest.raises(FrameSourceError, match=text):
        open_source(**wanted)


def test_a_camera_that_lists_nothing_is_asked(open_source, plug):
    silent = {raw.IOC.ENUM_FRAMESIZES: errno.ENOTTY, raw.IOC.ENUM_FRAMEINTERVALS: errno.ENOTTY}
    plug(fault=silent)
    assert open_source(frame_rate=25.0).frame_rate == 25.0
    plug("CAM2", {"GREY": {(640, 480): (30,)}}, fault=silent, number=2, port="1-3")
    with pytest.raises(FrameSourceError, match=r"found GREY 640 x 480 px .*, expected GREY 64 x"):
        open_source("CAM2")
    plug("CAM3", fault=silent, made_rate=15, number=4, port="1-4")
    with pytest.raises(FrameSourceError, match=r"frame_rate: found 15 Hz .*, expected 25 Hz"):
        open_source("CAM3", frame_rate=25.0)
    unpaced = {**silent, raw.IOC.S_PARM: errno.ENOTTY, raw.IOC.G_PARM: errno.ENOTTY}
    plug("CAM4", fault=unpaced, number=6, port="1-5")
    assert open_source("CAM4").frame_rate == 0.0


@pytest.mark.parametrize("order", [raw.Field.INTERLACED, raw.Field.ALTERNATE, raw.Field.SEQ_TB])
def test_a_camera_that_interlaces_is_refused(open_source, plug, order):
    """Its pictures have rows of two times.

    Reports: kylemcdonald/ofxBlackmagic 9, meantone/sunxi-tvin 4.
    """
    plug(field_order=order)
    with pytest.raises(FrameSourceError, match=f"field order: found {order.name.lower()}"):
        open_source()


def test_a_device_that_is_not_there_lists_those_that_are(open_source, plug):
    with pytest.raises(FrameSourceError, match="found no 'X', expected a video device"):
        open_source("X")
    plug(number=2)
    listed = r"one of: .*/video2 \(Tactile: Camera, serial CAM1, usb-1-2-video-index0\)"
    with pytest.raises(FrameSourceError, match=f"device: found no 'X', expected {listed}"):
        open_source("X")
    with pytest.raises(FrameSourceError, match=f"device: found nothing, expected {listed}"):
        open_source("")


def test_two_devices_of_one_serial_are_distinguished_by_path(open_source, plug):
    plug("0001", number=0, port="1-2")
    plug("0001", number=2, port="1-3")
    with pytest.raises(FrameSourceError, match=r"found 2 of serial 0001, expected a path: .*1-3"):
        open_source("0001")
    assert open_source("usb-1-3-video-index0").diagnostics["device"].name == "video2"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"openable": errno.EACCES}, r"video0: open: found no permission, .*group video"),
        ({"openable": errno.EBUSY}, r"video0: open: found it in use by another .*fuser -v"),
        ({"caps": raw.Capability.META_CAPTURE}, "found a video device for META_CAPTURE, expected"),
        ({"fault": {raw.IOC.QUERYCAP: errno.ENOTTY}}, "a device that cannot do this"),
        ({"fault": {raw.IOC.REQBUFS: errno.EBUSY}}, "in use by another driver"),
        ({"fault": {raw.IOC.S_FMT: errno.EIO}}, "error Input/output error, expected frames"),
    ],
)
def test_a_device_that_cannot_be_opened_says_why_and_is_given_back(
    handles, open_source, plug, changes, text
):
    plug(**changes)
    before = handles()
    with pytest.raises(FrameSourceError, match=text):
        open_source()
    assert handles() == before


def test_a_second_driver_is_refused_while_the_first_has_frames(open_source, plug):
    plug()
    first = open_source()
    first.start()
    with pytest.raises(FrameSourceError, match="found it in use by another driver or program"):
        open_source()
    first.stop()
    second = open_source()
    second.start()
    with pytest.raises(FrameSourceError, match=r"start of the frames: found it in use"):
        first.start()
    second.close()
    first.start()


def test_frames_that_the_kernel_had_no_buffer_for_are_counted(open_source, plug, picture):
    camera = plug()
    source = open_source()
    source.start()
    for _ in range(7):
        camera.give(picture.tobytes())
    assert all(source.poll(20.0) is not None for _ in range(4))
    camera.give(picture.tobytes())
    assert source.poll(20.0).origin.endswith("video0 frame 7")
    assert source.health.dropped_frames == 3


@pytest.mark.parametrize(
    ("stamp", "kind"),
    [
        ((raw.BufferFlag.TIMESTAMP_MONOTONIC, 20_000_000), "end of frame"),
        ((raw.BufferFlag.TIMESTAMP_UNKNOWN, 20_000_000), "arrival"),
        ((raw.BufferFlag.TIMESTAMP_MONOTONIC, 10**11), "arrival"),
        ((raw.BufferFlag.TIMESTAMP_MONOTONIC, -(10**9)), "arrival"),
    ],
)
def test_the_time_of_a_frame(open_source, plug, picture, stamp, kind):
    flags, age_ns = stamp
    camera = plug(buffer_flags=flags)
    source = open_source(stamp_offset=-0.5)
    source.start()
    exposed = time.monotonic_ns() - age_ns
    camera.give(picture.tobytes(), time_ns=exposed)
    asked = time.monotonic_ns()
    time_ns = source.poll(20.0).monotonic_ns + 500_000_000
    assert source.diagnostics["stamps"].startswith(kind)
    if kind == "arrival":
        assert asked <= time_ns <= time.monotonic_ns()
    else:
        assert exposed - 1000 <= time_ns <= exposed  # the kernel counts whole microseconds
