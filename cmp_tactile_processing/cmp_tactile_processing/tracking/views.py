"""All views of a sensor: camera frames in, the numbered gridlines of each view out."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.threads import ViewThreads, one_thread
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.geometry.split import check_image, split_frame
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.print_inspection.defects import PrintDefects
from cmp_tactile_processing.tracking.tracker import GridTracker


class ViewTrackers:
    """Tracks the views of a sensor at once, one of them on a thread that ends with this object.

    One frame at a time: calls from several threads must take turns.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self._sensor = sensor
        views = build_views(sensor) if sensor.views else {}
        self._views = [_TrackedView(sensor, view) for view in views.values()]
        self._threads = ViewThreads(len(self._views))

    @one_thread()  # entered here it costs nothing within
    def track(self, frame: NDArray[np.uint8], name: str = "frame") -> dict[str, Grid]:
        """Gridlines, by view, of a camera frame, (H, W) grey or (H, W, 3) BGR uint8.

        Raises FrameError, which calls it by that name, for a frame of another size or type.
        """
        frame = np.asarray(frame)
        check_image(frame, *self._sensor.frame_size, name)
        tracked = self._threads.map(lambda view: view.track(frame), self._views)
        return {view.name: grid for view, grid in zip(self._views, tracked, strict=True)}

    def inspect_print(self, frames: Iterable[NDArray[np.uint8]]) -> None:
        """Judge the print as each view shows it in frames of the gel at rest.

        See `GridTracker.inspect_print`; where a view raises, those before it keep what they found.
        """
        frames = list(frames)
        for view in self._views:
            view.tracker.inspect_print(view.cut(frame) for frame in frames)

    def reset(self) -> None:
        """Forget what earlier frames showed; what is known of the print is kept."""
        for view in self._views:
            view.tracker.reset()

    @property
    def pattern_doubt(self) -> str:
        """What a view shows of the pattern that the description lacks; or empty."""
        return next(filter(None, (view.tracker.pattern_doubt for view in self._views)), "")

    @property
    def print_defects(self) -> dict[str, PrintDefects | None]:
        """The flaws of the print that `inspect_print` showed in each view."""
        return {view.name: view.tracker.print_defects for view in self._views}


class _TrackedView:
    """One view's tracker, and the buffer that the view is cut into."""

    def __init__(self, sensor: SensorDescription, view: ViewGeometry) -> None:
        self.name = view.name
        self.tracker = GridTracker(sensor, view.name)
        self._placement = view.placement
        self._image = np.zeros((0, 0), np.uint8)

    def track(self, frame: NDArray[np.uint8]) -> Grid:
        """Gridlines of the view in a frame."""
        return self.tracker.track(self.cut(frame))

    def cut(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The view's part of a frame, un-mirrored; the next one takes its place."""
        shape = (self._placement.height, self._placement.width, *frame.shape[2:])
        if self._image.shape != shape:
            self._image = np.empty(shape, np.uint8)
        return split_frame(frame, self._placement, self._image)
