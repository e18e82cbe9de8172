"""Video devices: which there are, the one that is meant, and what errors of the kernel mean.

Controls of a camera are exposure, gain and whatever else it has, as it describes them itself.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from linuxpy.ioctl import ioctl
from linuxpy.video import device as v4l2
from linuxpy.video.device import V4L2Error

from cmp_tactile_driver.errors import FrameSourceError, SourceNotReadyError

GONE = (errno.ENODEV, errno.ENXIO, errno.ENOENT)
FORBIDDEN = (errno.EACCES, errno.EPERM)


class UnpluggedError(SourceNotReadyError):
    """A camera that was there and is no more."""


DEVICE_ERRORS = (FrameSourceError, V4L2Error, OSError, ValueError)
"""What a camera on its way out or in may cause, those of linuxpy among them."""


def error_text(device: str, action: str, error: Exception) -> str:
    """What an error of DEVICE_ERRORS says to a user."""
    if isinstance(error, FrameSourceError):
        return str(error)
    return f"{device}: {action}: found the error {str(error) or repr(error)}, expected a camera"


def device_error(path: Path | str, action: str, error: OSError) -> FrameSourceError:
    """The error for a user: the device, what was tried, what was found and what is expected."""
    text = f"{path}: {action}: {_reason(path, error)}"
    if error.errno in GONE:
        return UnpluggedError(text)
    # udev gives the permission a moment after the kernel has made the device.
    return SourceNotReadyError(text) if error.errno in FORBIDDEN else FrameSourceError(text)


def _reason(path: Path | str, error: OSError) -> str:
    number = error.errno
    if number in FORBIDDEN:
        return (
            "found no permission, expected a user of the group video "
            "(sudo usermod -aG video $USER, then log in again)"
        )
    if number == errno.EBUSY:
        return (
            "found it in use by another driver or program, expected it free "
            f"(fuser -v {path} names who has it)"
        )
    if number in GONE:
        return "found it unplugged, expected a camera"
    if number in (errno.ENOTTY, errno.EINVAL):
        return f"found a device that cannot do this ({error.strerror}), expected a V4L2 camera"
    if number == errno.ENOSPC:
        return "found too little USB bandwidth, expected a bus for this camera alone or less data"
    return f"found the error {error.strerror or error}, expected frames"


DEV = Path("/dev")
SYS = Path("/sys/class/video4linux")
LINKS = ("v4l/by-id", "v4l/by-path")


@dataclass(frozen=True)
class VideoDevice:
    """A node below /dev.

    serial: of the USB device; empty where it has none.  index: of the node among those of its
    device; a webcam's frames come from 0, and 1 has its metadata.  links: below /dev/v4l.
    """

    path: Path
    name: str = ""
    serial: str = ""
    index: int = 0
    links: tuple[Path, ...] = ()

    @property
    def text(self) -> str:
        """The device for a message."""
        parts = [self.name, self.serial and f"serial {self.serial}"]
        parts += [link.name for link in self.links if link.parent.name == "by-path"]
        known = ", ".join(part for part in parts if part)
        return f"{self.path} ({known})" if known else str(self.path)


def video_devices() -> list[VideoDevice]:
    """All video devices of this machine, by number."""
    nodes = sorted(DEV.glob("video*"), key=_number)
    return [_describe(path) for path in nodes if path.name[5:].isdigit()]


def find_device(chosen: str, serial: str = "") -> VideoDevice:
    """The device of that serial number, link or path.

    serial: of the device that was there before; it is found wherever it is plugged in now, and no
    other one is taken for it.
    Raises FrameSourceError listing what there is, SourceNotReadyError where it may still come.
    """
    devices = video_devices()
    if not chosen:
        msg = f"device: found nothing, expected {_listing(devices)}"
        raise FrameSourceError(msg)
    if serial and len(again := _of_serial(serial, devices)) == 1:
        return again[0]
    device = _by_path(chosen, devices) or _by_serial(chosen, devices)
    if device is None:
        msg = f"device: found no {chosen!r}, expected {_listing(devices)}"
        raise SourceNotReadyError(msg)
    if serial and device.serial != serial:
        msg = f"device: found {device.text} at {chosen}, expected the one with serial {serial}"
        raise FrameSourceError(msg)
    return device


def _by_path(chosen: str, devices: Sequence[VideoDevice]) -> VideoDevice | None:
    path = Path(chosen).expanduser()
    places = [path] if path.is_absolute() else [DEV / chosen, DEV / "v4l" / chosen]
    if len(path.parts) == 1:
        places += [DEV / folder / chosen for folder in LINKS]
    for place in places:
        if place.exists() and not place.is_dir():
            node = place.resolve()
            known = [item for item in devices if item.path.resolve() == node]
            return known[0] if known else VideoDevice(node)
    return None


def _by_serial(chosen: str, devices: Sequence[VideoDevice]) -> VideoDevice | None:
    found = _of_serial(chosen, devices)
    if len(found) > 1:
        msg = f"device: found {len(found)} of serial {chosen}, expected a path: {_listing(found)}"
        raise FrameSourceError(msg)
    return found[0] if found else None


def _of_serial(serial: str, devices: Sequence[VideoDevice]) -> list[VideoDevice]:
    nodes = [item for item in devices if item.serial == serial]
    first = min((item.index for item in nodes), default=0)
    return [item for item in nodes if item.index == first]


def _listing(devices: Sequence[VideoDevice]) -> str:
    if not devices:
        return "a video device; there is none on this machine"
    return "one of: " + "; ".join(item.text for item in devices)


def _describe(path: Path) -> VideoDevice:
    entry = SYS / path.name
    links = [link for folder in LINKS for link in sorted((DEV / folder).glob("*"))]
    index = _read(entry / "index")
    # The interface of a USB device; its parent is the device, which has the serial number.
    usb = (entry / "device").resolve().parent
    return VideoDevice(
        path=path,
        name=_read(entry / "name"),
        serial=_read(usb / "serial") if (usb / "idVendor").exists() else "",
        index=int(index) if index.isdigit() else 0,
        links=tuple(link for link in links if link.resolve() == path.resolve()),
    )


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def _number(path: Path) -> int:
    digits = re.search(r"\d+$", path.name)
    return int(digits.group()) if digits else -1


ControlValue = int | bool | str

ID, FLAG, TYPE = v4l2.ControlID, v4l2.ControlFlag, v4l2.ControlType
# Which automatic control rules which; the kernel says only that one of them does.
RULED_BY = {
    ID.EXPOSURE_ABSOLUTE: (ID.EXPOSURE_AUTO,),
    ID.EXPOSURE: (ID.EXPOSURE_AUTO, ID.AUTOGAIN),
    ID.GAIN: (ID.AUTOGAIN, ID.EXPOSURE_AUTO),
    ID.ANALOGUE_GAIN: (ID.AUTOGAIN, ID.EXPOSURE_AUTO),
    ID.ISO_SENSITIVITY: (ID.ISO_SENSITIVITY_AUTO,),
    ID.WHITE_BALANCE_TEMPERATURE: (ID.AUTO_WHITE_BALANCE,),
    ID.RED_BALANCE: (ID.AUTO_WHITE_BALANCE,),
    ID.BLUE_BALANCE: (ID.AUTO_WHITE_BALANCE,),
    ID.FOCUS_ABSOLUTE: (ID.FOCUS_AUTO,),
    ID.BRIGHTNESS: (ID.AUTOBRIGHTNESS,),
    ID.HUE: (ID.HUE_AUTO,),
}
RULERS = {ruler for rulers in RULED_BY.values() for ruler in rulers}


class ControlKind(Enum):
    """What values a control takes."""

    INTEGER = "integer"
    BOOLEAN = "boolean"
    MENU = "menu"
    BUTTON = "button"
    TEXT = "text"


KINDS = {
    TYPE.INTEGER: ControlKind.INTEGER,
    TYPE.INTEGER64: ControlKind.INTEGER,
    TYPE.BITMASK: ControlKind.INTEGER,
    TYPE.BOOLEAN: ControlKind.BOOLEAN,
    TYPE.MENU: ControlKind.MENU,
    TYPE.INTEGER_MENU: ControlKind.MENU,
    TYPE.BUTTON: ControlKind.BUTTON,
    TYPE.STRING: ControlKind.TEXT,
}


@dataclass(frozen=True)
class Control:
    """One control.  name: of the parameter.  title: what the camera calls it.

    low, high: of integers and menus, of a text its length.  choices: of a menu, number and text.
    fixed: can be read alone.  info: the structure of the kernel.
    """

    name: str
    title: str
    kind: ControlKind
    low: int
    high: int
    step: int
    choices: tuple[tuple[int, str], ...]
    fixed: bool
    info: Any

    @property
    def id(self) -> int:
        """The kernel's number."""
        return int(self.info.id)


class CameraControls:
    """The controls of an open linuxpy Device, by name."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self._skipped: list[str] = []
        self.by_name: dict[str, Control] = {}
        for control in self._read():
            self.by_name[control.name] = control
            try:
                self.value(control.name)
            except FrameSourceError:
                self._skipped.append(self.by_name.pop(control.name).title)
        self._by_id = {item.id: item for item in self.by_name.values()}

    @property
    def skipped(self) -> tuple[str, ...]:
        """Titles of controls that cannot be read, or hold more than one value."""
        return tuple(self._skipped)

    def value(self, name: str) -> ControlValue:
        """What the camera has now; of what can only be written, its default.

        Raises FrameSourceError.
        """
        control = self._existing(name)
        info = control.info
        if control.kind is ControlKind.BUTTON:
            return False
        if info.flags & FLAG.WRITE_ONLY:
            value: Any = info.default_value
        else:
            try:
                (value,) = v4l2.get_controls_values(self._device, [info])
            except OSError as error:
                raise device_error(self._device.filename, control.name, error) from None
        if control.kind is ControlKind.TEXT:
            return str(value)
        return bool(value) if control.kind is ControlKind.BOOLEAN else int(value)

    def values(self) -> dict[str, ControlValue]:
        """All values; raises FrameSourceError."""
        return {name: self.value(name) for name in self.by_name}

    def obstacle(self, name: str) -> str:
        """Why a control cannot be set now, in words; empty where it can."""
        control = self.by_name[name]
        flags = self._flags(control)
        if flags & (FLAG.READ_ONLY | FLAG.DISABLED):
            return "the camera sets it by itself"
        if flags & FLAG.GRABBED:
            return "in use; it can be set while the node is inactive"
        if flags & FLAG.INACTIVE:
            return f"without effect {self._ruled_by(control)}"
        return ""

    def set(self, values: Mapping[str, ControlValue]) -> None:
        """Set all or none; automatic controls first, because others depend on them.

        Raises FrameSourceError naming the control and why it cannot be set.
        """
        done: dict[str, ControlValue] = {}
        for name in self._in_order(values):
            try:
                before = self.value(name)
                self._set_one(name, values[name])
            except FrameSourceError:
                self.restore(done)
                raise
            done[name] = before

    def restore(self, values: Mapping[str, ControlValue], *, also_equal: bool = False) -> list[str]:
        """Set what can be set, as after the camera was away; what could not be, in words.

        also_equal: set also what reads as if it were so already.
        """
        failures = []
        for name in self._in_order(values):
            control = self.by_name.get(name)
            if control is None or control.fixed or control.kind is ControlKind.BUTTON:
                continue
            try:
                if self._flags(control) & FLAG.INACTIVE:
                    continue
                if not also_equal and self.value(name) == values[name]:
                    continue
                self._set_one(name, values[name])
            # A text for what is a number now, of a camera with other firmware, is a ValueError.
            except (FrameSourceError, ValueError) as error:
                failures.append(str(error))
        return failures

    def kept_otherwise(self, values: Mapping[str, ControlValue]) -> list[str]:
        """Controls that have an effect now and are not as they were asked to be, in words.

        Rounding to the control's range and steps is none.  Raises FrameSourceError.
        """
        texts = []
        for name, wanted in values.items():
            control = self.by_name.get(name)
            if control is None or control.kind is ControlKind.BUTTON or self.obstacle(name):
                continue
            found = self.value(name)
            # With other firmware a menu may have become a number.
            if control.kind is ControlKind.INTEGER and not isinstance(wanted, str):
                nearest = min(max(int(wanted), control.low), control.high)
                is_kept = abs(int(found) - nearest) < max(control.step, 1)
            else:
                is_kept = found == wanted
            if not is_kept:
                texts.append(f"{name}: asked for {wanted}, the camera keeps {found}")
        return texts

    def _existing(self, name: str) -> Control:
        control = self.by_name.get(name)
        if control is None:
            msg = f"{self._device.filename}: {name}: found no such control"
            raise FrameSourceError(msg)
        return control

    def _in_order(self, names: Mapping[str, ControlValue]) -> list[str]:
        def is_ruled(name: str) -> bool:
            control = self.by_name.get(name)
            return control is None or not (control.id in RULERS or control.info.flags & FLAG.UPDATE)

        return sorted(names, key=is_ruled)

    def _set_one(self, name: str, value: ControlValue) -> None:
        control = self._existing(name)
        if control.kind is ControlKind.BUTTON and not value:
            return
        if obstacle := self.obstacle(name):
            msg = f"{self._device.filename}: {name}: {obstacle}"
            raise FrameSourceError(msg)
        if control.choices and value not in dict(control.choices):
            choices = ", ".join(f"{number}: {text}" for number, text in control.choices)
            msg = f"{self._device.filename}: {name}: found {value}, expected one of {choices}"
            raise FrameSourceError(msg)
        raw_value = value if control.kind is ControlKind.TEXT else int(value)
        try:
            v4l2.set_controls_values(self._device, [(control.info, raw_value)])
        except OSError as error:
            action = f"{name}: set to {value!r}"
            raise device_error(self._device.filename, action, error) from None

    def _flags(self, control: Control) -> int:
        query = v4l2.raw.v4l2_query_ext_ctrl(id=control.id)
        try:
            ioctl(self._device, v4l2.IOC.QUERY_EXT_CTRL, query)
        except OSError as error:
            raise device_error(self._device.filename, control.name, error) from None
        return int(query.flags)

    def _ruled_by(self, control: Control) -> str:
        rulers = [self._by_id.get(ruler) for ruler in RULED_BY.get(control.id, ())]
        texts = []
        for ruler in rulers:
            if ruler is not None:
                value = self.value(ruler.name)
                choice = dict(ruler.choices).get(int(value), "") if ruler.choices else ""
                texts.append(f"{ruler.name} is {value}" + (f" ({choice})" if choice else ""))
        return f"while {' and '.join(texts)}" if texts else "while an automatic control rules it"

    def _read(self) -> Iterator[Control]:
        names: set[str] = set()
        for info in v4l2.iter_read_controls(self._device):
            if info.type == TYPE.CTRL_CLASS or info.flags & FLAG.DISABLED:
                continue
            title = info.name.decode(errors="replace")
            kind = KINDS.get(info.type)
            is_array = info.nr_of_dims or (
                info.flags & FLAG.HAS_PAYLOAD and info.type != TYPE.STRING
            )
            if kind is None or is_array:
                self._skipped.append(title)
                continue
            name = re.sub(r"[^a-z0-9]+", "_", title.lower()).strip("_") or f"control_{info.id:x}"
            if name in names:
                name = f"{name}_{info.id:x}"
            names.add(name)
            yield Control(
                name=name,
                title=title,
                kind=kind,
                low=info.minimum,
                high=info.maximum,
                step=info.step,
                choices=tuple(self._choices(info)) if kind is ControlKind.MENU else (),
                fixed=bool(info.flags & FLAG.READ_ONLY),
                info=info,
            )

    def _choices(self, info: Any) -> Iterator[tuple[int, str]]:
        item = v4l2.raw.v4l2_querymenu(id=info.id)
        numbers = {"start": info.minimum, "stop": info.maximum + 1}
        menu = v4l2.iter_read(self._device, v4l2.IOC.QUERYMENU, item, ignore_einval=True, **numbers)
        for entry in menu:
            is_text = info.type == TYPE.MENU
            text = entry.name.decode(errors="replace") if is_text else str(entry.value)
            yield entry.index, text
