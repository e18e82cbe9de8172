"""What files of bags have in common, whatever their format."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import zstandard

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
HEAD_BYTES = 12
"""Of a message: what names the encoding, and the stamp of a header that it begins with."""


class DamageError(Exception):
    """Bytes that are no message, no file of its format, or are not there."""


@dataclass(frozen=True)
class Place:
    """Where a message lies.

    time_ns: when it was received.  stamp_ns: of its header, if its type begins with one; 0 where it
    has none.  where: for the reading of its file, which is the `file`th of its bag.
    """

    topic: str
    kind: str
    time_ns: int
    stamp_ns: int
    where: Any
    file: int = 0


def unpacked(data: bytes) -> bytes:
    """A message that rosbag2 may have compressed by itself; DamageError where it cannot be."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    # Takes frames that do not state how long their content is, too.
    unpacking = zstandard.ZstdDecompressor().decompressobj()
    try:
        content = unpacking.decompress(data)
    except zstandard.ZstdError as error:
        raise DamageError(str(error)) from None
    if not unpacking.eof:
        raise DamageError("a compressed message is incomplete")
    return content


def head_stamp_ns(head: bytes) -> int:
    """The stamp in the first HEAD_BYTES of a message that begins with a header; 0 for none."""
    if len(head) < HEAD_BYTES:
        return 0
    order = "<" if head[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", head, 4)
    return max(0, int(seconds) * 10**9 + int(nanoseconds))


def full_kind(name: str, encoding: str = "cdr") -> str:
    """A message type as ROS 2 writes it, marked where its messages are not in CDR."""
    package, _, short = name.replace("::", "/").partition("/")
    kind = f"{package}/msg/{short}" if short and "/" not in short else f"{package}/{short}"
    return kind if encoding == "cdr" else f"{kind} in {encoding or 'unknown encoding'}"
