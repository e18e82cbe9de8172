"""Errors that the package raises on purpose; anything else is a bug."""

__all__ = [
    "CalibrationError",
    "CmpTactileError",
    "DescriptionError",
    "FrameError",
    "GeometryError",
    "ParameterError",
    "ReferenceFramesError",
    "printable",
]


def printable(text: str) -> str:
    """A text that people gave as one line: what would steer a terminal is shown as its escape."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class CmpTactileError(Exception):
    """Base of all errors that a user can cause and mend."""


class CalibrationError(CmpTactileError):
    """Images from which nothing can be calibrated: too few, wrong ones, of another rig."""


class DescriptionError(CmpTactileError):
    """A sensor description that cannot be used: names file, key, found and expected."""


class FrameError(CmpTactileError):
    """A camera frame or view image of the wrong size or type."""


class GeometryError(CmpTactileError):
    """Arrays whose shapes do not belong together, or a rig that lacks what is asked of it."""


class ParameterError(CmpTactileError):
    """A parameter outside its range."""


class ReferenceFramesError(CmpTactileError):
    """Frames that cannot serve as a reference."""
