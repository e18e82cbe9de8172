"""Node: finds the gridlines of one view."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cmp_tactile_msgs.msg import Grid as GridMsg
from cmp_tactile_processing.cache.compiled import when_compiling
from cmp_tactile_processing.drawing import draw_grid
from cmp_tactile_processing.errors import CalibrationError, Finding, InputError, Severity
from cmp_tactile_processing.image.encodings import BitDepth
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.nodes.health import GridHealth
from cmp_tactile_processing.ros.base_nodes import IMAGE_DEPTH, Answer, FrameService, StageNode
from cmp_tactile_processing.ros.messages.conversions import (
    grid_to_msg,
    header_at,
    image_from_topic,
    image_to_msg,
)
from cmp_tactile_processing.ros.messages.making import view_frame
from cmp_tactile_processing.ros.parameters import (
    ImageInputParameters,
    StageParameters,
    declare_parameters,
)
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.ros.rviz import DrawingRate, OverlayParameters
from cmp_tactile_processing.sensor.parameters import Parameters, TrackingParameters, parameter
from cmp_tactile_processing.tracking.print_inspection.defects import PrintDefects
from cmp_tactile_processing.tracking.tracker import GridTracker


@dataclass(frozen=True)
class PrintParameters(Parameters, section="print"):
    """From what the print is inspected."""

    print_frames: int = parameter(
        8, "number of frames that inspect_print averages", within=(1, 100)
    )
    print_timeout: float = parameter(
        10.0, "time after which inspect_print gives up", unit="s", within=(0.1, 3600.0)
    )


@dataclass(frozen=True)
class GridlineTrackerParameters(ImageInputParameters):
    """What is fixed while the node runs."""

    view: str = parameter("left", "view to track", choices=("left", "right"))


class GridlineTracker(StageNode):
    """Finds and numbers the gridlines in `<view>/image_raw`; one node per view.

    If an image shows no pattern, the grid has missing points, with `fault` and `reason`; the
    diagnostics report the worst fault of the last second.
    `<view>/grid_overlay` shows the image with the gridlines drawn in.  It is made only while
    somebody subscribes, at most `overlay_rate` times a second.  A change of a tracking parameter
    starts the tracker again.  The service `~/inspect_print` looks for flaws of the print in the
    next frames, in which the gel must be at rest.  Flawed corners are then measured by their
    pictures at rest; where these do not fit, they get a larger standard deviation.
    """

    default_name = "gridline_tracker"

    def _set_up(self) -> None:
        options = declare_parameters(self, GridlineTrackerParameters())
        self._view = options.view
        if self._view not in self.sensor.views:
            views = ", ".join(self.sensor.views)
            msg = (
                f"{self.get_fully_qualified_name()}: parameter view: found {self._view!r}, "
                f"expected one of {views}"
            )
            raise InputError(msg)
        tracking = StageParameters(self, self.sensor.tracking, self._build_tracker)
        self._print: PrintDefects | None = None
        self._build_tracker(tracking.value)
        self._print_options = StageParameters(self, PrintParameters(), lambda _: None)
        self._frame = view_frame(self.sensor, self._view)
        self._grid = self.add_result(GridMsg, f"{self._view}/grid", grid_to_msg)
        self._overlay_publisher = self.add_publisher(
            Image, f"{self._view}/grid_overlay", IMAGE_DEPTH
        )
        self._prepare_overlay()
        self._health = GridHealth()
        self._topic = f"{self._view}/image_raw"
        self._depth = BitDepth(self.resolve_topic_name(self._topic), self.get_logger().info)
        self.add_input(
            Image,
            self._topic,
            self._on_grid,
            self._read,
            begin=self._track,
            reliable=options.reliable_input,
        )
        self._inspection = FrameService[NDArray[np.uint8]](
            self,
            "~/inspect_print",
            "an inspection of the print is already running",
            self._wanted_for_print,
        )

    def _build_tracker(self, parameters: TrackingParameters) -> None:
        with when_compiling():
            tracker = GridTracker(replace(self.sensor, tracking=parameters), view=self._view)
        tracker.use_print_defects(self._print)
        self._tracker, self._weights = tracker, parameters.grey_weights

    def _read(self, msg: Image) -> NDArray[np.uint8]:
        return image_from_topic(msg, self._weights, self._depth)

    def _track(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Grid]:
        return image, self._tracker.track(image)

    def _on_grid(self, tracked: tuple[NDArray[np.uint8], Grid], camera_header: Header) -> None:
        image, grid = tracked
        header = header_at(camera_header.stamp, self._frame)
        self._grid.publish(grid, header)
        self._health.add(grid)
        self.frame_out(header)
        if self._inspection.is_open:
            collected = self._inspection.take(image.copy())
            if collected is not None:
                self._inspect_print(*collected)
        if self._overlay_publisher.get_subscription_count():
            self._tracked = image, grid, header
            self._overlay_rate.request()

    def _prepare_overlay(self) -> None:
        options = StageParameters(
            self, OverlayParameters(), lambda new: self._overlay_rate.limit(new.overlay_rate)
        )
        topic = self._overlay_publisher.topic_name
        self._overlay_rate = DrawingRate(
            self,
            lambda: self._run_guarded(topic, self._draw_overlay, self._tracked),
            options.value.overlay_rate,
        )

    def _draw_overlay(self, tracked: tuple[NDArray[np.uint8], Grid, Header]) -> None:
        image, grid, header = tracked
        self._overlay_publisher.publish(image_to_msg(draw_grid(image, grid), "bgr8", header))

    def _start_again(self, _topic: str) -> None:
        self._tracker.reset()

    def _wanted_for_print(self) -> tuple[int, float, str]:
        options = self._print_options.value
        return options.print_frames, options.print_timeout, self.resolve_topic_name(self._topic)

    def _inspect_print(self, frames: list[NDArray[np.uint8]], finish: Answer) -> None:
        try:
            self._print = self._tracker.inspect_print(frames)
            self.get_logger().info(self._print.report)
            finish(True, self._print.report)
        except CalibrationError as error:
            self.get_logger().warning(f"print not inspected: {error}")
            finish(False, str(error))
        finally:
            # Whatever else went wrong is reported by the node; who asked must not wait for it.
            finish(False, "the inspection failed, see the node's log")

    def _update_diagnostics(self) -> None:
        note, figures = self._health.close_period()
        if figures and not note.text:
            note = Finding(Severity.WARNING, self._tracker.pattern_doubt)
        self.diagnostics.note = note
        self.diagnostics.extra = {"view": self._view, **figures}


def main() -> int:
    """Entry point of `ros2 run cmp_tactile_processing gridline_tracker`."""
    return run_node(GridlineTracker)


if __name__ == "__main__":
    sys.exit(main())
