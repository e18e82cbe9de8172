"""The calls of V4L2 that a capture device answers, by their numbers."""

import ctypes
import errno
import os
from typing import Any

from linuxpy.video import raw

from .camera import FLAG, TYPE, FakeCamera, fail

IOC = raw.IOC
NEXT = FLAG.NEXT_CTRL | FLAG.NEXT_COMPOUND


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
    pix.field = camera.field_order


def _set_rate(camera: FakeCamera, parm: Any, number: int) -> None:
    _own(camera, number)
    interval = parm.parm.capture.timeperframe
    camera.rate = (camera.made_rate or interval.denominator, interval.numerator)


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
    camera.resets_left = camera.resets
    camera.reset()


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
        elif not (camera.streaming and item.name in camera.insists):
            item.value = item.used = max(item.low, min(item.high, entry.value))


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
