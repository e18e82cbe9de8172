"""A camera: its controls and modes, and the frames that it is to give."""

import errno
import os
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from linuxpy.video import raw

ID, FLAG, TYPE = raw.ControlID, raw.ControlFlag, raw.CtrlType
MONOTONIC, EXPOSURE = raw.BufferFlag.TIMESTAMP_MONOTONIC, raw.BufferFlag.TSTAMP_SRC_SOE
BYTES_PER_PIXEL = {"GREY": 1, "YUYV": 2, "BGR3": 3, "RGB3": 3, "MJPG": 2, "H264": 2}


def fail(number: int) -> OSError:
    return OSError(number, os.strerror(number))


@dataclass
class FakeControl:
    """A control; while `ruler` has another value than `manual`, it is inactive.

    used: the value that the camera works with.
    """

    id: int
    name: str
    type: int
    low: int = 0
    high: int = 1
    step: int = 1
    default: Any = 0
    flags: int = 0
    menu: dict[int, Any] = field(default_factory=dict)
    ruler: int = 0
    manual: int = 0
    value: Any = None

    def __post_init__(self) -> None:
        self.value = self.default if self.value is None else self.value
        self.used = self.value


def webcam_controls() -> list[FakeControl]:
    """What a UVC camera has, and a few rarer kinds."""
    exposure_menu = {0: "Auto Mode", 1: "Manual Mode", 3: "Aperture Priority Mode"}
    text = FLAG.HAS_PAYLOAD
    return [
        FakeControl(0x980001, "User Controls", TYPE.CTRL_CLASS, flags=FLAG.READ_ONLY),
        FakeControl(ID.BRIGHTNESS, "Brightness", TYPE.INTEGER, -64, 64, default=8),
        FakeControl(
            ID.AUTO_WHITE_BALANCE,
            "White Balance, Automatic",
            TYPE.BOOLEAN,
            default=1,
            flags=FLAG.UPDATE,
        ),
        FakeControl(ID.GAIN, "Gain", TYPE.INTEGER, 0, 100, default=20),
        FakeControl(
            ID.POWER_LINE_FREQUENCY,
            "Power Line Frequency",
            TYPE.MENU,
            high=2,
            default=1,
            menu={0: "Disabled", 1: "50 Hz", 2: "60 Hz"},
        ),
        FakeControl(
            ID.WHITE_BALANCE_TEMPERATURE,
            "White Balance Temperature",
            TYPE.INTEGER,
            2800,
            6500,
            10,
            4600,
            ruler=ID.AUTO_WHITE_BALANCE,
        ),
        FakeControl(0x980930, "Firmware", TYPE.STRING, 0, 31, 1, "1.07", text | FLAG.READ_ONLY),
        FakeControl(0x980931, "Calibrate Sensor", TYPE.BUTTON, flags=FLAG.WRITE_ONLY),
        FakeControl(0x980932, "Link Frequency", TYPE.INTEGER_MENU, menu={0: 400, 1: 800}),
        FakeControl(0x980933, "Gamma Table", TYPE.U8, 0, 255, flags=text),
        FakeControl(
            ID.EXPOSURE_AUTO,
            "Auto Exposure",
            TYPE.MENU,
            high=3,
            default=3,
            flags=FLAG.UPDATE,
            menu=exposure_menu,
        ),
        FakeControl(
            ID.EXPOSURE_ABSOLUTE,
            "Exposure Time, Absolute",
            TYPE.INTEGER,
            1,
            5000,
            default=157,
            ruler=ID.EXPOSURE_AUTO,
            manual=1,
        ),
    ]


@dataclass
class FakeCamera:
    """A camera; what its fields are set to is what it does from then on.

    modes: rates by pixel format and size.  made_rate: of any rate that it is asked for.
    fault: error numbers by ioctl.  resets: that many times after the start of streaming, with the
    first at once and the next ones before a frame, all controls have their defaults again.
    insists: titles of controls that then keep them.  conceals: what is read does not show it.
    """

    serial: str = "CAM1"
    modes: dict[str, dict[tuple[int, int], tuple[int, ...]]] = field(
        default_factory=lambda: {"GREY": {(64, 48): (30, 60)}}
    )
    controls: list[FakeControl] = field(default_factory=webcam_controls)
    caps: int = raw.Capability.VIDEO_CAPTURE | raw.Capability.STREAMING
    buffer_flags: int = MONOTONIC | EXPOSURE
    openable: int = 0
    fault: dict[int, int] = field(default_factory=dict)
    extra_step: int = 0
    made_rate: int = 0
    pushed: int = 0
    resets: int = 0
    insists: tuple[str, ...] = ()
    conceals: bool = False
    field_order: int = raw.Field.NONE

    def __post_init__(self) -> None:
        self.node: Path | None = None
        self.changed = threading.Condition()
        self.unplug_state()

    def unplug_state(self) -> None:
        self.node = None
        self.owner = 0
        self.streaming = False
        self.format = ("GREY", 64, 48)
        self.rate = (30, 1)
        self.queued: list[int] = []
        self.done: list[raw.v4l2_buffer] = []
        self.sequence = 0
        self.resets_left = 0

    def reset(self) -> None:
        """Give controls their defaults, where there are resets left."""
        if self.resets_left > 0:
            self.resets_left -= 1
            for item in self.controls:
                item.used = item.default
                if not self.conceals:
                    item.value = item.default

    @property
    def step(self) -> int:
        """Bytes per line."""
        name, width, _ = self.format
        return width * BYTES_PER_PIXEL[name] + self.extra_step

    @property
    def length(self) -> int:
        """Bytes of a buffer, in whole pages as the kernel maps it."""
        return -(-self.step * self.format[2] // 4096) * 4096

    def give(self, data: bytes, *, time_ns: int | None = None, flags: int = 0) -> None:
        """A frame was exposed; it is lost where no buffer waits for it."""
        with self.changed:
            sequence, self.sequence = self.sequence, self.sequence + 1
            if not (self.streaming and self.queued and self.node):
                return
            self.reset()
            index = self.queued.pop(0)
            with self.node.open("r+b") as memory:
                memory.seek(index * self.length)
                memory.write(data)
            buffer = self.buffer(index)
            buffer.bytesused, buffer.sequence = len(data), sequence
            buffer.flags = self.buffer_flags | flags
            stamp = time.monotonic_ns() if time_ns is None else time_ns
            buffer.timestamp.secs, rest = divmod(stamp, 10**9)
            buffer.timestamp.usecs = rest // 1000
            self.done.append(buffer)
            self.changed.notify_all()

    def buffer(self, index: int) -> raw.v4l2_buffer:
        buffer = raw.v4l2_buffer(index=index, type=1, memory=1, length=self.length)
        buffer.m.offset = index * self.length
        return buffer

    def control(self, number: int) -> FakeControl:
        for item in self.controls:
            if item.id == number:
                return item
        raise fail(errno.EINVAL)

    def named(self, name: str) -> FakeControl:
        return next(item for item in self.controls if item.name == name)

    def flags_of(self, item: FakeControl) -> int:
        ruled = item.ruler and self.control(item.ruler).value != item.manual
        return item.flags | (FLAG.INACTIVE if ruled else 0)
