"""The whole chain: split -> track -> triangulate -> force.  The only module that joins stages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.compiled import compiling_is_logged
from cmp_tactile_processing.cache.threads import ViewThreads, one_thread
from cmp_tactile_processing.errors import ReferenceFramesError
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.geometry.optics import ViewGeometry
from cmp_tactile_processing.geometry.split import check_image, split_frame
from cmp_tactile_processing.measured import ForceField, Grid, Markers3D, Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.surface.gauge import RestGauge
from cmp_tactile_processing.surface.reference_keeping import ReferenceKeeper, ZeroParameters
from cmp_tactile_processing.tracking.print_inspection.defects import PrintDefects
from cmp_tactile_processing.tracking.tracker import GridTracker

Shown: TypeAlias = "NDArray[np.uint8] | Surface"
"""A camera frame, or the surface that a sensor without a camera has measured."""


@dataclass(frozen=True)
class PipelineResult:
    """What one frame showed.  A monocular sensor's other grid is None, and both of a surface."""

    left: Grid | None
    right: Grid | None
    surface: Surface
    force: ForceField


class Pipeline:
    """Processes frames of one sensor; the force model is built once and cached on disk.

    The views are tracked at once, one on the caller's thread and one on a thread that ends with
    the pipeline.  One frame at a time: calls from several threads must take turns.
    """

    def __init__(
        self, sensor: SensorDescription, auto_reference: str = "never", *, encoded: bool = False
    ) -> None:
        """auto_reference: when a reference is taken by itself: never, when_still, at_start.

        As the parameter of the node, whose default is when_still; ParameterError for another.
        encoded: the frames were a video of H.264 or the like.
        """
        self._sensor = sensor
        with compiling_is_logged():
            self._rig = StereoRig(sensor) if sensor.views else None
            views = self._rig.views if self._rig else {}
            self._views = [_TrackedView(sensor, view) for view in views.values()]
            self._threads = ViewThreads(len(self._views))
            self._force = ForceStage(sensor, encoded=encoded)
            gauge = RestGauge(sensor) if sensor.views else None
            self._keeper = ReferenceKeeper(Reference.nominal(sensor), gauge)
        self._auto = auto_reference != "never"
        self._keeper.zero(ZeroParameters(auto_reference=auto_reference))
        self._reference_note = ""

    @one_thread()  # entered here it costs nothing within
    def process(self, frame: Shown, stamp_ns: int | None = None) -> PipelineResult:
        """Everything that a frame, (H, W) grey or (H, W, 3) BGR uint8, shows.

        A surface that was measured elsewhere keeps its reference until one is taken.
        stamp_ns: when it was taken; relaxation of the gel is taken out only where that is known.
        Raises FrameError for a frame of another size or type.
        """
        grids, markers = self._measure(frame)
        if self._auto:
            self._reference_note = self._keeper.add(markers, stamp_ns or 0) or self._reference_note
        reference = self._keeper.reference
        if isinstance(markers, Surface) and not reference.id:
            surface = markers
        else:
            surface = reference.surface(markers)
        force = self._force.process(surface, stamp_ns)
        return PipelineResult(grids.get("left"), grids.get("right"), surface, force)

    def set_reference(self, frames: Iterable[Shown], stamp_ns: int = 0) -> None:
        """Measure displacements against the mean of these frames of the gel at rest from now on.

        stamp_ns: of the last of them, kept as the time of the reference.
        The print is judged from images, too: see `print_defects`.  Raises ReferenceFramesError
        where they cannot serve, FrameError for a wrong frame; all then stays as it was.
        """
        frames = list(frames)
        markers = [self._measure(frame)[1] for frame in frames]
        Reference.average(markers, 0)  # raises where they cannot serve, before anything changes
        known = self.print_defects
        images = [frame for frame in frames if not isinstance(frame, Surface)]
        try:
            for view in self._views if images else ():
                view.inspect_print(images)
            if any(
                found and (found.flawed.known.any() or found.bands.loss)
                for found in (*known.values(), *self.print_defects.values())
            ):
                # Flawed corners are now where their new pictures have them, or the model.
                markers = [self._measure(frame)[1] for frame in frames]
                Reference.average(markers, 0)
        except ReferenceFramesError:
            for view in self._views:
                view.tracker.use_print_defects(known[view.name])
            raise
        self._reference_note = self._keeper.take(markers, stamp_ns)

    @property
    def reference_note(self) -> str:
        """What is to be said of the last reference that was taken; empty where none was."""
        return self._reference_note

    @property
    def reference_doubt(self) -> str:
        """Why no reference was taken by itself, or how the gel drifted from it; or empty."""
        return (self._keeper.reason or self._keeper.warning()) if self._auto else ""

    @property
    def pattern_doubt(self) -> str:
        """What a view shows of the pattern that the description lacks; or empty."""
        return next(filter(None, (view.tracker.pattern_doubt for view in self._views)), "")

    @property
    def print_defects(self) -> dict[str, PrintDefects | None]:
        """The flaws of the print that the frames of `set_reference` showed in each view."""
        return {view.name: view.tracker.print_defects for view in self._views}

    def reset(self) -> None:
        """Forget earlier frames, as after start-up; keeps the reference."""
        for view in self._views:
            view.tracker.reset()
        self._force.reset()

    def _measure(self, frame: Shown) -> tuple[dict[str, Grid], Markers3D]:
        if isinstance(frame, Surface):
            return {}, frame
        frame = np.asarray(frame)
        check_image(frame, *self._sensor.frame_size, "frame")
        assert self._rig is not None  # noqa: S101  what has a frame size has views
        tracked = self._threads.map(lambda view: view.track(frame), self._views)
        grids = {view.name: grid for view, grid in zip(self._views, tracked, strict=True)}
        return grids, self._rig.triangulate(grids.get("left"), grids.get("right"))


class _TrackedView:
    """One view's tracker, and the buffer that the view is cut into."""

    def __init__(self, sensor: SensorDescription, view: ViewGeometry) -> None:
        self.name = view.name
        self.tracker = GridTracker(sensor, view.name)
        self._placement = view.placement
        self._image = np.zeros((0, 0), np.uint8)

    def track(self, frame: NDArray[np.uint8]) -> Grid:
        """Gridlines of the view in a frame."""
        return self.tracker.track(self._cut(frame))

    def inspect_print(self, frames: Sequence[NDArray[np.uint8]]) -> None:
        """Judge the print as this view shows it in frames at rest."""
        self.tracker.inspect_print(self._cut(frame) for frame in frames)

    def _cut(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        shape = (self._placement.height, self._placement.width, *frame.shape[2:])
        if self._image.shape != shape:
            self._image = np.empty(shape, np.uint8)
        return split_frame(frame, self._placement, self._image)
