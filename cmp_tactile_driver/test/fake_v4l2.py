"""A V4L2 capture device that is not there: what the kernel does, below linuxpy.

Devices are regular files below a folder that stands for /dev; their buffers are mapped from them
for real.  `fcntl.ioctl`, `open` and `select` of linuxpy are answered here, from and into the
structures of the kernel.  Nothing of linuxpy itself is replaced.
"""

from __future__ import annotations

import ctypes
import errno
import os
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import linuxpy.io
import linuxpy.ioctl
from linuxpy.video import raw

from cmp_tactile_driver import v4l2_devices

IOC, ID, FLAG, TYPE = raw.IOC, raw.ControlID, raw.ControlFlag, raw.CtrlType
NEXT = FLAG.NEXT_CTRL | FLAG.NEXT_COMPOUND
MONOTONIC, EXPOSURE = raw.BufferFlag.TIMESTAMP_MONOTONIC, raw.BufferFlag.TSTAMP_SRC_SOE
BYTES_PER_PIXEL = {"GREY": 1, "YUYV": 2, "BGR3": 3, "RGB3": 3, "MJPG": 2, "H264": 2}


def fail(number: int) -> OSError:
    return OSError(number, os.strerror(number))


@dataclass
class FakeControl:
    """A control; while `ruler` has another value than `manual`, it is inactive."""

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

    modes: rates by pixel format and size.  fault: error numbers by ioctl.
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
    calls: list[int] = field(default_factory=list)
    pushed: int = 0

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


class FakeKernel:
    """The machine: a folder /dev, a folder /sys, and cameras that are plugged in."""

    def __init__(self, root: Path) -> None:
        self.dev, self.sys = root / "dev", root / "sys" / "class" / "video4linux"
        self.usb = root / "sys" / "devices" / "usb1"
        for folder in (self.dev / "v4l/by-id", self.dev / "v4l/by-path", self.sys, self.usb):
            folder.mkdir(parents=True)
        self.cameras: dict[str, FakeCamera] = {}

    def install(self, monkeypatch: Any) -> None:
        monkeypatch.setattr(v4l2_devices, "DEV", self.dev)
        monkeypatch.setattr(v4l2_devices, "SYS", self.sys)
        real_open = linuxpy.io.IO.open

        def opener(path: Path, *args: Any, **kwargs: Any) -> Any:
            camera = self.cameras.get(Path(path).name)
            if camera is not None and camera.openable:
                raise fail(camera.openable)
            return real_open(path, *args, **kwargs)

        monkeypatch.setattr(linuxpy.io.IO, "open", opener)
        monkeypatch.setattr(linuxpy.io.IO, "select", SimpleNamespace(select=self.select))
        monkeypatch.setattr(linuxpy.ioctl, "fcntl", SimpleNamespace(ioctl=self.ioctl))

    def plug(self, camera: FakeCamera, number: int = 0, port: str = "1-2") -> Path:
        """The camera appears as /dev/videoN, with the files of a USB device in /sys."""
        node = self.dev / f"video{number}"
        node.touch()
        device = self.usb / port
        interface = device / f"{port}:1.0"
        entry = interface / "video4linux" / node.name
        entry.mkdir(parents=True, exist_ok=True)
        (device / "idVendor").write_text("1bcf\n")
        if camera.serial:
            (device / "serial").write_text(camera.serial + "\n")
        (entry / "name").write_text("Tactile: Camera\n")
        (entry / "index").write_text("0\n")
        (entry / "device").symlink_to(interface)
        (self.sys / node.name).symlink_to(entry)
        for kind, name in (("by-id", f"usb-Tactile_{camera.serial}"), ("by-path", f"usb-{port}")):
            link = self.dev / "v4l" / kind / f"{name}-video-index0"
            link.unlink(missing_ok=True)  # of two devices of one serial the last has the link
            link.symlink_to(node)
        camera.node = node
        self.cameras[node.name] = camera
        return node

    def unplug(self, camera: FakeCamera) -> None:
        """The node and its links vanish; who has it open gets ENODEV."""
        assert camera.node is not None
        with camera.changed:
            node = camera.node
            del self.cameras[node.name]
            links = [*self.dev.glob("v4l/*/*")]
            for path in [link for link in links if link.resolve() == node]:
                path.unlink()
            entry = (self.sys / node.name).resolve()
            (self.sys / node.name).unlink()
            for path in (entry / "device", entry / "name", entry / "index"):
                path.unlink()
            (entry.parents[2] / "serial").unlink(missing_ok=True)
            node.unlink()
            camera.unplug_state()
            camera.changed.notify_all()

    def select(self, readers: Any, _writers: Any, _errors: Any, timeout: float) -> Any:
        (reader,) = readers
        camera = self._camera(reader.fileno())
        if camera is None:
            return readers, (), ()
        with camera.changed:
            camera.changed.wait_for(lambda: camera.done or camera.node is None, timeout)
            # An error is what a device is ready for, too.
            ready = camera.done or camera.node is None or IOC.DQBUF in camera.fault
            return (readers if ready else ()), (), ()

    def _camera(self, number: int) -> FakeCamera | None:
        path = str(Path(f"/proc/self/fd/{number}").readlink())
        return self.cameras.get(Path(path).name) if "(deleted)" not in path else None

    def ioctl(self, device: Any, request: int, argument: Any) -> int:
        number = device.fileno()
        camera = self._camera(number)
        if camera is None:
            raise fail(errno.ENODEV)
        with camera.changed:
            camera.calls.append(request)
            if request in camera.fault:
                raise fail(camera.fault[request])
            handler = HANDLERS.get(request)
            if handler is None:
                raise fail(errno.ENOTTY)
            handler(camera, argument, number)
        return 0


def _query_capabilities(camera: FakeCamera, caps: Any, _: int) -> None:
    caps.driver, caps.card, caps.bus_info = b"fake", b"Tactile: Camera", b"usb-1"
    caps.device_caps, caps.capabilities = camera.caps, camera.caps


def _pick(items: Any, index: int) -> Any:
    if index >= len(items):
        raise fail(errno.EINVAL)
    return list(items)[index]


def _name_of(code: int) -> str:
    return code.to_bytes(4, "little").decode()


def _enumerate_formats(camera: FakeCamera, entry: Any, _: int) -> None:
    if entry.type != raw.BufType.VIDEO_CAPTURE:
        raise fail(errno.EINVAL)
    entry.pixelformat = raw.v4l2_fourcc(*_pick(camera.modes, entry.index))


def _enumerate_sizes(camera: FakeCamera, entry: Any, _: int) -> None:
    sizes = camera.modes[_name_of(entry.pixel_format)]
    size = _pick(sizes, entry.index)
    entry.type = raw.Frmsizetypes.DISCRETE
    entry.discrete.width, entry.discrete.height = size


def _enumerate_intervals(camera: FakeCamera, entry: Any, _: int) -> None:
    rates = camera.modes[_name_of(entry.pixel_format)].get((entry.width, entry.height), ())
    entry.type = raw.Frmivaltypes.DISCRETE
    entry.discrete.numerator, entry.discrete.denominator = 1, _pick(rates, entry.index)


def _own(camera: FakeCamera, number: int) -> None:
    if camera.owner not in (0, number):
        raise fail(errno.EBUSY)


def _set_format(camera: FakeCamera, fmt: Any, number: int) -> None:
    _own(camera, number)
    pix = fmt.fmt.pix
    name = _name_of(pix.pixelformat)
    name = name if name in camera.modes else next(iter(camera.modes))
    sizes = list(camera.modes[name])
    wanted = (pix.width, pix.height)
    camera.format = (name, *(wanted if wanted in sizes else sizes[0]))
    _get_format(camera, fmt, number)


def _get_format(camera: FakeCamera, fmt: Any, _: int) -> None:
    name, pix = camera.format[0], fmt.fmt.pix
    _, pix.width, pix.height = camera.format
    pix.pixelformat = raw.v4l2_fourcc(*name)
    pix.bytesperline = 0 if name in ("MJPG", "H264") else camera.step
    pix.sizeimage = camera.step * pix.height


def _set_rate(camera: FakeCamera, parm: Any, number: int) -> None:
    _own(camera, number)
    interval = parm.parm.capture.timeperframe
    camera.rate = (interval.denominator, interval.numerator)


def _get_rate(camera: FakeCamera, parm: Any, _: int) -> None:
    interval = parm.parm.capture.timeperframe
    interval.denominator, interval.numerator = camera.rate


def _request_buffers(camera: FakeCamera, request: Any, number: int) -> None:
    _own(camera, number)
    camera.owner = number if request.count else 0
    camera.queued, camera.done = [], []
    assert camera.node is not None
    os.truncate(camera.node, request.count * camera.length)


def _query_buffer(camera: FakeCamera, buffer: Any, _: int) -> None:
    found = camera.buffer(buffer.index)
    ctypes.memmove(ctypes.byref(buffer), ctypes.byref(found), ctypes.sizeof(found))


def _enqueue(camera: FakeCamera, buffer: Any, number: int) -> None:
    _own(camera, number)
    camera.queued.append(buffer.index)


def _dequeue(camera: FakeCamera, buffer: Any, _: int) -> None:
    if not camera.streaming:
        raise fail(errno.EINVAL)
    if not camera.done:
        raise fail(errno.EAGAIN)
    found = camera.done.pop(0)
    ctypes.memmove(ctypes.byref(buffer), ctypes.byref(found), ctypes.sizeof(found))


def _stream_on(camera: FakeCamera, _kind: Any, number: int) -> None:
    if camera.owner != number:
        raise fail(errno.EBUSY if camera.owner else errno.EINVAL)
    camera.streaming, camera.sequence = True, 0


def _stream_off(camera: FakeCamera, _kind: Any, _: int) -> None:
    camera.streaming, camera.queued, camera.done = False, [], []


def _query_control(camera: FakeCamera, query: Any, _: int) -> None:
    number = query.id & ~NEXT
    if query.id & NEXT:
        later = sorted((item for item in camera.controls if item.id > number), key=lambda i: i.id)
        item = _pick(later, 0)
    else:
        item = camera.control(number)
    query.id, query.type, query.name = item.id, item.type, item.name.encode()
    query.minimum, query.maximum, query.step = item.low, item.high, item.step
    query.default_value = 0 if item.type == TYPE.STRING else item.default
    query.flags = camera.flags_of(item)
    query.elem_size, query.elems, query.nr_of_dims = 4, 1, int(item.type == TYPE.U8)


def _query_menu(camera: FakeCamera, query: Any, _: int) -> None:
    item = camera.control(query.id)
    if query.index not in item.menu:
        raise fail(errno.EINVAL)
    if item.type == TYPE.MENU:
        query.name = item.menu[query.index].encode()
    else:
        query.m1.value = item.menu[query.index]


def _get_controls(camera: FakeCamera, request: Any, _: int) -> None:
    for index in range(request.count):
        entry = request.controls[index]
        item = camera.control(entry.id)
        if item.flags & FLAG.WRITE_ONLY:
            raise fail(errno.EACCES)
        if item.type == TYPE.STRING:
            text = item.value.encode() + b"\0"
            ctypes.memmove(entry.string, text, len(text))
        else:
            entry.value = item.value


def _set_controls(camera: FakeCamera, request: Any, _: int) -> None:
    for index in range(request.count):
        entry = request.controls[index]
        item = camera.control(entry.id)
        if item.flags & FLAG.READ_ONLY:
            raise fail(errno.EACCES)
        if item.type == TYPE.BUTTON:
            camera.pushed += 1
        elif item.menu and entry.value not in item.menu:
            raise fail(errno.ERANGE)
        else:
            item.value = max(item.low, min(item.high, entry.value))


HANDLERS = {
    IOC.QUERYCAP: _query_capabilities,
    IOC.ENUM_FMT: _enumerate_formats,
    IOC.ENUM_FRAMESIZES: _enumerate_sizes,
    IOC.ENUM_FRAMEINTERVALS: _enumerate_intervals,
    IOC.S_FMT: _set_format,
    IOC.G_FMT: _get_format,
    IOC.S_PARM: _set_rate,
    IOC.G_PARM: _get_rate,
    IOC.REQBUFS: _request_buffers,
    IOC.QUERYBUF: _query_buffer,
    IOC.QBUF: _enqueue,
    IOC.DQBUF: _dequeue,
    IOC.STREAMON: _stream_on,
    IOC.STREAMOFF: _stream_off,
    IOC.QUERY_EXT_CTRL: _query_control,
    IOC.QUERYMENU: _query_menu,
    IOC.G_EXT_CTRLS: _get_controls,
    IOC.S_EXT_CTRLS: _set_controls,
}
