"""What every source of camera frames offers, and which sources are installed.

A package offers a source by an entry point of the group `cmp_tactile_frame_sources`: its name is
the driver's parameter `source`, and it loads to a function from SourceOptions to a FrameSource.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.sources.parameters import CameraParameters
from cmp_tactile_processing.errors import Finding, FrameSourceError, InputError, Severity
from cmp_tactile_processing.ros.messages.making import encoding_of
from cmp_tactile_processing.sensor.description import SensorDescription

ImageSize = tuple[int, int]
"""Width and height, px."""

# So many frames of another size, and none before them that is right: it is another camera's
# recording, and the rest need not be read to say so.  One alone may be left over from another mode.
MOST_WRONG_SIZES = 2

ENTRY_POINT_GROUP = "cmp_tactile_frame_sources"


@dataclass(frozen=True)
class Frame:
    """One camera frame.

    image: (H, W) uint8 grey, or (H, W, 3) uint8 BGR.  origin: what to call it in a message, such
    as its file's name.  monotonic_ns: when it was exposed, on the clock of `time.monotonic_ns`;
    None where the source does not know, which makes it the time of publishing.
    """

    image: NDArray[np.uint8]
    origin: str
    monotonic_ns: int | None = field(default=None, kw_only=True)

    @property
    def encoding(self) -> str:
        """The ROS name of the pixel format: mono8 or bgr8."""
        return encoding_of(self.image)


@dataclass(frozen=True)
class SourceHealth:
    """What a source could not give: the number of frames, and the last reason (or "").

    silent: no frames come for now, for that reason.  dropped_frames: good ones that were not read
    in time.
    """

    bad_frames: int = 0
    problem: str = ""
    silent: bool = False
    dropped_frames: int = 0

    def __add__(self, other: SourceHealth) -> SourceHealth:
        """That of two sources together."""
        return SourceHealth(
            self.bad_frames + other.bad_frames,
            "; ".join(filter(None, (self.problem, other.problem))),
            silent=self.silent or other.silent,
            dropped_frames=self.dropped_frames + other.dropped_frames,
        )

    def with_bad_frame(self, problem: str) -> SourceHealth:
        """One bad frame more."""
        return SourceHealth(self.bad_frames + 1, problem)

    @property
    def finding(self) -> Finding:
        """The last reason, an error while no frames come."""
        return Finding(Severity.ERROR if self.silent else Severity.WARNING, self.problem)

    @property
    def summary(self) -> str:
        """What could not be given, in words; empty where all could."""
        if self.bad_frames > 1:
            return f"{self.bad_frames} bad frames, last: {self.problem}"
        return self.problem


class RepeatedPictures:
    """Counts how often the same picture came in a row: a camera's noise makes two alike unlikely.

    A camera that has stopped, its driver or a recorder may repeat the last picture.
    """

    def __init__(self) -> None:
        self._last: NDArray[np.uint8] | None = None
        self._in_a_row = 0

    def add(self, picture: NDArray[np.uint8]) -> int:
        """How often this picture, pixels or the bytes of a file, has now come; 1 for a new one."""
        same = self._last is not None and np.array_equal(picture, self._last)
        self._in_a_row = self._in_a_row + 1 if same else 1
        self._last = picture
        return self._in_a_row


@dataclass(frozen=True)
class SourceOptions:
    """What a source is opened with.

    input: what to open, in the source's own terms: a path, a name.  frame_rate: frames per
    second, Hz; 0 for the source's own.  loop: begin again at the end.  sensor: to which the
    camera belongs.  camera: what only a camera needs.
    """

    input: str
    sensor: SensorDescription
    frame_rate: float = 0.0
    loop: bool = False
    camera: CameraParameters = field(default_factory=CameraParameters)

    @property
    def frame_size(self) -> ImageSize:
        """The size that every frame must have."""
        return self.sensor.frame_size


VIEWS = ("left", "right")


def join_views(
    sensor: SensorDescription, images: Sequence[NDArray[np.uint8]], name: str
) -> NDArray[np.uint8]:
    """The frame of a sensor whose left and right view are images of two cameras.

    Raises FrameSourceError, which begins with name, where only one is in colours.
    """
    kinds = [encoding_of(image) for image in images]
    if kinds[0] != kinds[1]:
        msg = f"{name}: found {kinds[0]} and {kinds[1]}, expected both cameras grey or both colour"
        raise FrameSourceError(msg)
    width, height = sensor.frame_size
    joined = np.zeros((height, width, *images[0].shape[2:]), np.uint8)
    for view, image in zip(VIEWS, images, strict=True):
        roi = sensor.views[view].roi
        joined[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width] = image
    return joined


class FrameSource(Protocol):
    """Gives frames one after another.  Used from one thread."""

    @property
    def name(self) -> str:
        """What it is, for messages: a folder, a file, a device."""

    @property
    def frame_rate(self) -> float:
        """Nominal frames per second; the reader keeps to it."""

    @property
    def health(self) -> SourceHealth:
        """What was lost so far."""

    def read(self) -> Frame | None:
        """The next good frame, or None at the end; bad ones are skipped and counted.

        Raises FrameSourceError where no frame can be had at all.
        """

    def close(self) -> None:
        """Give back files and devices."""


@runtime_checkable
class SelfPacedSource(FrameSource, Protocol):
    """A source whose frames come when they come, as a camera's do; it does not end."""

    def start(self) -> None:
        """Let frames come.  Raises FrameSourceError where none can."""

    def stop(self) -> None:
        """Let no more come; those that wait are forgotten.  Not while another thread polls."""

    def poll(self, timeout: float) -> Frame | None:
        """The next good frame, or None where none came within so many seconds."""


@runtime_checkable
class InterruptibleSource(FrameSource, Protocol):
    """A source with a `read` that may take long."""

    def interrupt(self) -> None:
        """Give no more frames; a `read` that another thread waits in raises FrameSourceError."""


class NodeExtension(Protocol):
    """What a source adds to the node that publishes its frames: topics, services, parameters."""

    def frame_sent(self, frame: Frame, header: Any) -> None:
        """A frame was published with this std_msgs/Header.  From the thread that reads."""

    @property
    def diagnostics(self) -> Mapping[str, object]:
        """Figures of the source's own for /diagnostics, by name."""

    def close(self) -> None:
        """Take everything back from the node."""


@runtime_checkable
class WithNodeExtension(Protocol):
    """A source that has more to offer than frames."""

    def extend(self, node: Any) -> NodeExtension:
        """Add what the source offers to a rclpy node.  Raises CmpTactileError for a parameter."""


def size_text(size: ImageSize) -> str:
    """An image size for a message."""
    return f"{size[0]} x {size[1]} px"


SourceFactory = Callable[[SourceOptions], FrameSource]
"""Opens a source; raises CmpTactileError where it gives no frames."""


def source_names() -> tuple[str, ...]:
    """The kinds of sources that are installed."""
    return tuple(sorted({point.name for point in entry_points(group=ENTRY_POINT_GROUP)}))


def find_source(name: str) -> SourceFactory:
    """What opens sources of that kind.

    Raises InputError for a kind that is not installed, FrameSourceError for one that cannot
    be imported.
    """
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.name == name:
            try:
                factory: SourceFactory = point.load()
            except ModuleNotFoundError as error:
                msg = (
                    f"source {name}: found no Python module {error.name}, expected it installed: "
                    f"pip install {str(error.name).partition('.')[0]}"
                )
                raise FrameSourceError(msg) from None
            except Exception as error:
                reason = f"{type(error).__name__}: {error}"
                msg = f"source {name}: {point.value} cannot be imported: {reason}"
                raise FrameSourceError(msg) from error
            return factory
    known = ", ".join(source_names()) or "none that is installed"
    msg = f"camera_driver.source: found {name!r}, expected one of {known}"
    raise InputError(msg)
