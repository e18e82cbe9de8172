"""What the kernel's error numbers mean to someone who wants frames of a camera."""

from __future__ import annotations

import errno
from pathlib import Path

from linuxpy.video.device import V4L2Error

from cmp_tactile_driver.errors import FrameSourceError, SourceNotReadyError

__all__ = ["DEVICE_ERRORS", "UnpluggedError", "device_error", "error_text"]

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
