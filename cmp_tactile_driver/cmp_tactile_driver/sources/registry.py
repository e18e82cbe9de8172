"""Finds the kinds of frame sources that are installed, through Python entry points.

A package offers a source by an entry point of the group `cmp_tactile_frame_sources`: its name is
the driver's parameter `source`, and it loads to a function from SourceOptions to a FrameSource.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.frames import FrameSource, SourceOptions
from cmp_tactile_processing.errors import ParameterError

__all__ = ["ENTRY_POINT_GROUP", "SourceFactory", "find_source", "source_names"]

ENTRY_POINT_GROUP = "cmp_tactile_frame_sources"

SourceFactory = Callable[[SourceOptions], FrameSource]
"""Opens a source; raises CmpTactileError where it gives no frames."""


def source_names() -> tuple[str, ...]:
    """The kinds of sources that are installed."""
    return tuple(sorted({point.name for point in entry_points(group=ENTRY_POINT_GROUP)}))


def find_source(name: str) -> SourceFactory:
    """What opens sources of that kind.

    Raises ParameterError for a kind that is not installed, FrameSourceError for one that cannot
    be imported.
    """
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.name == name:
            try:
                factory: SourceFactory = point.load()
            except ModuleNotFoundError as error:
                msg = (
                    f"source {name}: found no Python module {error.name}, expected it to be "
                    f"installed: pip install {str(error.name).partition('.')[0]}"
                )
                raise FrameSourceError(msg) from None
            except Exception as error:
                reason = f"{type(error).__name__}: {error}"
                msg = f"source {name}: {point.value} cannot be imported: {reason}"
                raise FrameSourceError(msg) from error
            return factory
    known = ", ".join(source_names()) or "none that is installed"
    msg = f"camera_driver.source: found {name!r}, expected one of {known}"
    raise ParameterError(msg)
