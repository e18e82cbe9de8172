"""Errors of frame sources and recordings that a user can cause and repair."""

from cmp_tactile_processing.errors import CmpTactileError, FrameError


class FrameSourceError(CmpTactileError):
    """A folder, video or camera that gives no frames."""


class SourceNotReadyError(FrameSourceError):
    """What gives frames is not there, or not ready: it may be later, without anything changed."""


class BagError(FrameSourceError):
    """A bag that cannot be read, or that holds no images."""


class BagWriteError(CmpTactileError):
    """A bag that cannot be written: its place, the disk, or what is there already."""


class WrongSizeError(FrameError):
    """An image of another size than the camera's."""
