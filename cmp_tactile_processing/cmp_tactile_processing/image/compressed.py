"""Pixels of a compressed camera frame: PNG and JPEG, as image_transport names them; image files.

A JPEG is judged as strictly as libjpeg can, and read as cameras send it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError, found_text
from cmp_tactile_processing.image.raw import MAX_SIDE, BitDepth, demosaiced

START_OF_IMAGE = b"\xff\xd8"
END_OF_IMAGE = b"\xff\xd9"
START_OF_SCAN = 0xDA
RESTART_INTERVAL = 0xDD
# Of baseline and extended sequential JPEG, which cameras send.
SEQUENTIAL_FRAMES = (0xC0, 0xC1)
BLOCK_PX = 8

# Restart markers and the end of the image: what ends pixels.
PIXEL_ENDS = (*range(0xD0, 0xD8), 0xD9)
# Of pixels in reverse: bytes 0xff of their stream (0x00 follows each), or 0x00.
FILL = re.compile(rb"(?:\x00\xff)+|\x00+(?!\xff)")
# So many of the pixels' own last bytes can look like fill: two blocks without colour are 0x00.
MOST_KEPT = 2


def decode_jpeg(
    content: bytes,
    origin: str,
    *,
    size: tuple[int, int] | None = None,
    grey: bool = False,
) -> NDArray[np.uint8]:
    """The image of a JPEG: (H, W), or (H, W, 3) BGR where it has colours and not `grey`, uint8.

    size: width and height that it must have, px.  Read by libjpeg-turbo as OpenCV does, which
    keeps libjpeg's warnings for itself and fills up what is missing.  What loses no pixel is read:
    bytes that fill up before a marker, a missing end of the image, missing Huffman tables (libjpeg
    takes those of ITU-T T.81, K.3).
    Raises FrameError, which begins with `origin`, also where libjpeg only warns.
    """
    try:
        height, width, space, _ = simplejpeg.decode_jpeg_header(content, strict=False)
    except (ValueError, KeyError) as error:  # KeyError: a sampling of colours that is none
        msg = f"{origin}: found {len(content)} bytes that are not a readable image: {error}"
        raise FrameError(msg) from None
    expected = size or (min(width, MAX_SIDE), min(height, MAX_SIDE))
    if (width, height) != expected:
        msg = f"{origin}: found {width} x {height} px, expected {expected[0]} x {expected[1]} px"
        raise FrameError(msg)
    target = "CMYK" if space in ("CMYK", "YCCK") else "GRAY" if grey or space == "Gray" else "BGR"
    try:
        image = _decode_strictly(content, target)
    except ValueError as error:
        msg = f"{origin}: found a damaged JPEG of {len(content)} bytes ({error})"
        raise FrameError(msg) from None
    if target == "CMYK":
        flags = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR
        flags |= cv2.IMREAD_IGNORE_ORIENTATION
        return np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), flags), np.uint8)
    return image[..., 0] if target == "GRAY" else image


def _decode_strictly(content: bytes, target: str) -> NDArray[np.uint8]:
    """Raises ValueError where libjpeg warns, also of the content without fill."""
    problem = ""
    for reading in _readings(content):
        image, problem = _decoded(reading, target)
        if image is not None:
            return image
    raise ValueError(problem)


def _decoded(content: bytes, target: str) -> tuple[NDArray[np.uint8] | None, str]:
    """The image, or what libjpeg warns of first."""
    try:
        return np.asarray(simplejpeg.decode_jpeg(content, target, strict=True), np.uint8), ""
    except ValueError as error:
        return None, str(error)


def _readings(content: bytes) -> Iterator[bytes]:
    """As it is; without bytes 0xff that fill up; without all that fills up."""
    yield content
    segments, scan = _split(content)
    frame = _frame(segments, scan)
    if frame is None:
        yield b"".join([*segments, scan])
    else:
        yield frame.without_fill(exactly=False)
        yield frame.without_fill(exactly=True)


def _split(content: bytes) -> tuple[list[bytes], bytes]:
    """Segments of the header, without the bytes between them (ITU-T T.81, B.1.1.2); the scan."""
    segments, at = [START_OF_IMAGE], content.find(b"\xff", 2)
    while 0 <= at < len(content) - 4 and content[at + 1] != START_OF_SCAN:
        after = at + 2 + int.from_bytes(content[at + 2 : at + 4], "big")
        if content[at + 1] in (0x00, 0xFF):  # no marker, or fills up
            after = at + 1
        else:
            segments.append(content[at:after])
        at = content.find(b"\xff", after)
    return segments, content[at:] + END_OF_IMAGE


@dataclass(frozen=True)
class _Frame:
    """What a sequential frame of one scan is made of.

    segments: of the header.  index: of the frame header in them.  pixels: with restart markers.
    unit: width and height of a minimum coded unit (MCU), px.  across, down: number of units.
    interval: units from one restart marker to the next.
    """

    segments: list[bytes]
    index: int
    scan_header: bytes
    pixels: bytes
    unit: tuple[int, int]
    across: int
    down: int
    interval: int

    def without_fill(self, *, exactly: bool) -> bytes:
        """The JPEG without what fills up before restart markers and the end of the image.

        Logitech's cameras add a byte 0xff where the pixels end with a whole byte.  exactly: 0x00,
        too, and nothing that the pixels need, which takes longer to find out.
        """
        parts = _pixels_and_markers(self.pixels)
        left = self.across * self.down
        for number in range(0, len(parts) - 1, 2):
            units = min(self.interval, left)
            if units < 1:
                break
            parts[number] = self._least(parts[number], units if exactly else 0)
            left -= units
        return b"".join([*self.segments, self.scan_header, *parts])

    def _least(self, pixels: bytes, units: int) -> bytes:
        """Without 0xff that fill up; where units are given, the least that is enough for them."""
        found = FILL.match(pixels[::-1]) if pixels.endswith(b"\x00") else None
        if found is None:
            return pixels
        bare, fill = pixels[: -found.end()], pixels[-found.end() :]
        step = 1 if fill.startswith(b"\x00") else 2
        if not units:
            return bare if step == 2 else pixels
        least = (bare + fill[: step * kept] for kept in range(MOST_KEPT + 1))
        return next((part for part in least if self._is_whole(part, units)), pixels)

    def _is_whole(self, pixels: bytes, units: int) -> bool:
        columns = math.gcd(units, self.across)
        width, height = columns * self.unit[0], units // columns * self.unit[1]
        segments, frame = self.segments.copy(), self.segments[self.index]
        size = height.to_bytes(2, "big") + width.to_bytes(2, "big")
        segments[self.index] = frame[:5] + size + frame[9:]
        content = b"".join([*segments, self.scan_header, pixels, END_OF_IMAGE])
        return _decoded(content, "GRAY")[0] is not None


def _pixels_and_markers(scan: bytes) -> list[bytes]:
    """In turn, without the bytes 0xff that may stand before a marker (ITU-T T.81, B.1.1.2)."""
    data = np.frombuffer(scan, np.uint8)
    is_marker = (data[:-1] == 0xFF) & np.isin(data[1:], PIXEL_ENDS)
    parts, begin = list[bytes](), 0
    for at in np.flatnonzero(is_marker).tolist():
        parts += [scan[begin:at].rstrip(b"\xff"), scan[at : at + 2]]
        begin = at + 2
    return [*parts, scan[begin:]]


def _frame(segments: list[bytes], scan: bytes) -> _Frame | None:
    """None where it is no frame of one scan."""
    kinds = [segment[1] for segment in segments]
    index = next((i for i, kind in enumerate(kinds) if kind in SEQUENTIAL_FRAMES), None)
    if index is None or len(segments[index]) < 13 or len(scan) < 5:
        return None
    frame = segments[index]
    factors = frame[11::3]
    if scan[4] != len(factors):
        return None
    # The only component has units of one block, whatever its factors.
    in_x, in_y = (max(f >> 4 for f in factors), max(f & 15 for f in factors))
    width, height = (BLOCK_PX * in_x, BLOCK_PX * in_y) if len(factors) > 1 else (BLOCK_PX, BLOCK_PX)
    if not width or not height:
        return None
    across = math.ceil(int.from_bytes(frame[7:9], "big") / width)
    down = math.ceil(int.from_bytes(frame[5:7], "big") / height)
    interval = 0
    if RESTART_INTERVAL in kinds:
        interval = int.from_bytes(segments[kinds.index(RESTART_INTERVAL)][4:6], "big")
    begin = 2 + int.from_bytes(scan[2:4], "big")
    return _Frame(
        segments,
        index,
        scan_header=scan[:begin],
        pixels=scan[begin:],
        unit=(width, height),
        across=across,
        down=down,
        interval=interval or across * down,
    )


# What image_transport adds to the topic of an image.
COMPRESSED = "/compressed"


def decode_compressed(
    format_text: str, data: NDArray[np.uint8], depth: BitDepth | None = None
) -> NDArray[np.uint8]:
    """The image of a sensor_msgs/CompressedImage: (H, W) or (H, W, 3) BGR, uint8.

    format_text: its field `format`, such as "mono8; png compressed ", "rgb8; jpeg compressed bgr8"
    or "jpeg".  data: (N,).  depth: of the stream; absent for an image by itself.
    Raises FrameError for anything but png and jpeg, and for data that are no such image.
    """
    text = format_text.lower()
    if "compresseddepth" in text or not any(kind in text for kind in ("png", "jpeg", "jpg")):
        msg = f"format: found {found_text(format_text)}, expected png or jpeg"
        raise FrameError(msg)
    image = demosaiced(decode_image(data, "data", depth), text.partition(";")[0].strip())
    if image.ndim == 3 and "compressed rgb" in text:
        return np.ascontiguousarray(image[..., ::-1])
    return image


def decode_image(
    content: NDArray[np.uint8], origin: str, depth: BitDepth | None = None
) -> NDArray[np.uint8]:
    """The image of the bytes (N,) of an image file: (H, W) or (H, W, 3) BGR, uint8.

    depth: of the stream that the image is from; absent for an image by itself.
    Raises FrameError, which begins with `origin`, also for a JPEG that is damaged.
    """
    if content[:2].tobytes() == START_OF_IMAGE:
        return decode_jpeg(content.tobytes(), origin)
    try:
        image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    except cv2.error:  # a size beyond OpenCV's limit
        image = None
    if image is None:
        msg = f"{origin}: found {content.size} bytes that are not a readable image"
        raise FrameError(msg)
    if image.dtype not in (np.uint8, np.uint16):
        msg = f"{origin}: found {image.dtype} pixels, expected uint8 or uint16"
        raise FrameError(msg)
    if image.ndim == 3 and image.shape[2] == 4:
        # First: alpha uses all 16 bits.
        image = cv2.cvtColor(image, cv2.COLOR_BGRA2BGR)
    if image.dtype == np.uint16:
        image = (depth or BitDepth(origin)).to_8_bits(np.asarray(image, np.uint16))
    return np.asarray(image, np.uint8)
