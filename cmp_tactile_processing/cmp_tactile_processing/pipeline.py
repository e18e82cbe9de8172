"""The whole chain: split -> track -> triangulate -> force.  The only module that joins stages."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.compiled import when_compiling
from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.measured import ForceField, Grid, Markers3D, Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.surface.gauge import RestGauge
from cmp_tactile_processing.surface.reference_keeping import ReferenceKeeper, ZeroParameters
from cmp_tactile_processing.tracking.print_inspection.defects import PrintDefects
from cmp_tactile_processing.tracking.views import ViewTrackers

Shown: TypeAlias = "NDArray[np.uint8] | Surface"
"""A camera frame, or the surface that a sensor without a camera has measured."""


@dataclass(frozen=True)
class PipelineResult:
    """What one frame showed.  A monocular sensor's other grid is None, and both of a surface."""

    left: Grid | None
    right: Grid | None
    surface: Surface
    force: ForceField


class MarkerCamera:
    """The stages up to the markers in space; a sensor without views has measured them itself."""

    def __init__(self, sensor: SensorDescription) -> None:
        with when_compiling():
            self.views = ViewTrackers(sensor)
            self._rig = StereoRig(sensor) if sensor.views else None

    def measure(self, frame: Shown) -> tuple[dict[str, Grid], Markers3D]:
        """Grids, by view, and markers of a frame; FrameError for one of another size or type."""
        if isinstance(frame, Surface):
            return {}, frame
        grids = self.views.track(frame)
        assert self._rig is not None  # noqa: S101  what has a frame has views
        return grids, self._rig.triangulate(grids.get("left"), grids.get("right"))


class Pipeline:
    """Processes frames of one sensor; the force model is built once and cached on disk.

    The views are tracked at once, one on the caller's thread and one on a thread that ends with
    the pipeline.  One frame at a time: calls from several threads must take turns.
    """

    def __init__(
        self, sensor: SensorDescription, auto_reference: str = "never", *, encoded: bool = False
    ) -> None:
        """auto_reference: when a reference is taken by itself: never, when_still, at_start.

        As the parameter of the node, whose default is when_still; InputError for another.
        encoded: the frames were a video of H.264 or the like.
        """
        self._camera = MarkerCamera(sensor)
        with when_compiling():
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
        grids, markers = self._camera.measure(frame)
        if self._auto:
            self._reference_note = self._keeper.add(markers, stamp_ns or 0) or self._reference_note
        surface = self._keeper.surface(markers)
        force = self._force.process(surface, stamp_ns)
        return PipelineResult(grids.get("left"), grids.get("right"), surface, force)

    def set_reference(self, frames: Iterable[Shown], stamp_ns: int = 0) -> None:
        """Measure displacements against the mean of these frames of the gel at rest from now on.

        stamp_ns: of the last of them, kept as the time of the reference.
        The print is inspected first, see `inspect_print`.  Raises CalibrationError where they
        cannot serve, FrameError for a wrong frame; the reference then stays as it was.
        """
        frames = list(frames)
        markers = [self._camera.measure(frame)[1] for frame in frames]
        Reference.average(markers, 0)  # raises where they cannot serve, before anything changes
        known = self.print_defects
        self.inspect_print(frame for frame in frames if not isinstance(frame, Surface))
        found = filter(None, (*known.values(), *self.print_defects.values()))
        if any(item.flawed.known.any() or item.bands.loss for item in found):
            # Flawed corners are now where their new pictures have them, or the model.
            markers = [self._camera.measure(frame)[1] for frame in frames]
        self._reference_note = self._keeper.take(markers, stamp_ns)

    def inspect_print(self, images: Iterable[NDArray[np.uint8]]) -> None:
        """Look for flaws of the print in frames of the gel at rest, and allow for them from now on.

        A reference that was taken before no longer fits.  Raises as `GridTracker.inspect_print`;
        no images change nothing.
        """
        images = list(images)
        if images:
            self._camera.views.inspect_print(images)

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
        return self._camera.views.pattern_doubt

    @property
    def print_defects(self) -> dict[str, PrintDefects | None]:
        """The flaws of the print that the frames of `set_reference` showed in each view."""
        return self._camera.views.print_defects

    def reset(self) -> None:
        """Forget earlier frames, as after start-up; keeps the reference."""
        self._camera.views.reset()
        self._force.reset()
