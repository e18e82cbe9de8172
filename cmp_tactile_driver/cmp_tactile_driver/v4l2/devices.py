"""Video devices: which there are, the one that is meant, and what errors of the kernel mean."""

from __future__ import annotations

import errno
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from linuxpy.video.device import V4L2Error

from cmp_tactile_processing.cache.files import expanded_path
from cmp_tactile_processing.errors import FrameSourceError

GONE = (errno.ENODEV, errno.ENXIO, errno.ENOENT)
FORBIDDEN = (errno.EACCES, errno.EPERM)

DEVICE_ERRORS = (FrameSourceError, V4L2Error, OSError, ValueError)
"""What a camera on its way out or in may cause, those of linuxpy among them."""

DEV = Path("/dev")
SYS = Path("/sys/class/video4linux")
LINKS = ("v4l/by-id", "v4l/by-path")


def error_text(device: str, action: str, error: Exception) -> str:
    """What an error of DEVICE_ERRORS says to a user."""
    if isinstance(error, FrameSourceError):
        return str(error)
    return f"{device}: {action}: found the error {str(error) or repr(error)}, expected a camera"


def device_error(path: Path | str, action: str, error: OSError) -> FrameSourceError:
    """The error for a user: the device, what was tried, what was found and what is expected."""
    text = f"{path}: {action}: {_reason(path, error)}"
    # udev gives the permission a moment after the kernel has made the device.
    return FrameSourceError(text, may_come=error.errno in (*GONE, *FORBIDDEN))


def _reason(path: Path | str, error: OSError) -> str:
    number = error.errno
    if number in FORBIDDEN:
        return (
            "found no permission, expected a user of the group video "
            "(sudo usermod -aG video $USER, then log in again)"
        )
    if number == errno.EBUSY:
        return (
            f"found it in use by another driver or program, expected it free (fuser -v {path} "
            "shows the program)"
        )
    if number in GONE:
        return "found it unplugged, expected a camera"
    if number in (errno.ENOTTY, errno.EINVAL):
        return f"found a device that cannot do this ({error.strerror}), expected a V4L2 camera"
    if number == errno.ENOSPC:
        return (
            "found too little USB bandwidth, expected a bus without other cameras, or a lower "
            "frame rate or size"
        )
    return f"found the error {error.strerror or error}, expected frames"


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
    Raises FrameSourceError listing what there is; it may still come.
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
        raise FrameSourceError(msg, may_come=True)
    if serial and device.serial != serial:
        msg = f"device: found {device.text} at {chosen}, expected the camera with serial {serial}"
        raise FrameSourceError(msg)
    return device


def _by_path(chosen: str, devices: Sequence[VideoDevice]) -> VideoDevice | None:
    path = expanded_path(chosen)
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
        return "a video device; this machine has none"
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
