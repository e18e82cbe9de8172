"""Node: reconstructs the force on the gel from the displacement of its surface."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from functools import partial

from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.force.advice import ADVICE
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.measured import ForceFlag, Surface
from cmp_tactile_processing.nodes.health import ForceHealth
from cmp_tactile_processing.ros.base_nodes import StageNode
from cmp_tactile_processing.ros.messages import conversions
from cmp_tactile_processing.ros.messages.reading import check_shape, stamp_ns, surface_from_msg
from cmp_tactile_processing.ros.parameters import StageParameters, declare_parameters
from cmp_tactile_processing.ros.process import run_node, spare_the_collector
from cmp_tactile_processing.sensor.parameters import (
    ForceParameters,
    Parameters,
    SlipParameters,
    parameter,
)

# Of the frames of which the wrench alone is asked for, one in so many is looked at in full for the
# diagnostics.
REPORTED_FRAME = 10


@dataclass(frozen=True)
class ForceReconstructorParameters(Parameters):
    """What is fixed while the node runs."""

    wait_for_model: bool = parameter(False, "wait at the start until the force model is built")


class ForceReconstructor(StageNode):
    """Turns `surface` into `wrench`, which is published first, and `force_field`.

    Without contact `wrench` is 0.  `force_points` is made only while somebody subscribes.

    The first time, the finite-element model may take tens of seconds to build, in the background.
    Until then surfaces are counted and skipped, and the diagnostics say so.  With `wait_for_model`
    the constructor returns only when the model is ready.

    Parameters of force and slip may change while the node runs.  Those of slip take effect with the
    next frame, also for contacts that exist already.  Those of force build a new model; the old one
    is used meanwhile, and the state of a gel that relaxes is kept.

    A sensor with one view measures no depth.  Its tangential force is measured; its normal force
    and contact are inferred from how the gel spreads under a press, and can be wrong by a third.
    The camera must look at the gel from below: if it looks from the side, as through one mirror of
    two, a press looks like a shift and all forces are wrong.
    """

    default_name = "force_reconstructor"
    _gone = False

    def destroy_node(self) -> None:
        """Let the model be, then destroy the node."""
        self._gone = True
        super().destroy_node()

    def _set_up(self) -> None:
        self._options = declare_parameters(self, ForceReconstructorParameters())
        self._stage: ForceStage | None = None
        self._built: deque[ForceStage] = deque()
        self._one_view = len(self.sensor.views) == 1
        self._progress = "building the force model"
        self._health = ForceHealth()
        self._number = 0
        self._builds = threading.Lock()
        self._force = StageParameters(self, self.sensor.force, self._start_building)
        self._slip = StageParameters(self, self.sensor.slip, self._use_slip, "slip")
        builder = self._start_building()
        self._wrench = self.add_result(WrenchStamped, "wrench", conversions.wrench_to_msg)
        self._field = self.add_result(ForceFieldMsg, "force_field", conversions.force_field_to_msg)
        self._points_publisher = self.add_publisher(PointCloud2, "force_points")
        if self._options.wait_for_model:
            builder.join()
            self._adopt_built()
        shape = self.sensor.pattern.shape
        read = partial(surface_from_msg, shape=shape)
        self.add_input(SurfaceMsg, "surface", self._on_surface, read, needs_all=lambda: False)

    def _use_slip(self, parameters: SlipParameters) -> None:
        if self._stage is not None:
            self._stage.set_slip(parameters)

    def _start_building(self, _: object = None) -> threading.Thread:
        builder = threading.Thread(
            target=self._build, args=(self._force.value,), name="force model", daemon=True
        )
        builder.start()
        return builder

    def _build(self, wanted: ForceParameters) -> None:
        with self._builds:
            if wanted != self._force.value:
                return
            start = time.monotonic()
            try:
                sensor = replace(self.sensor, force=wanted)
                stage = ForceStage(sensor, progress=self._on_progress)
            except CancelledError:
                return
            except Exception as error:  # noqa: BLE001  the node lives on and says so
                self.diagnostics.failure = f"force model cannot be built: {error}"
                if not self._gone:
                    self.get_logger().error(self.diagnostics.failure)
                return
            self._built.append(stage)
            self.diagnostics.failure = ""
            if not self._gone:
                self.get_logger().info(f"force model ready after {time.monotonic() - start:.1f} s")

    def _adopt_built(self) -> None:
        """Between frames only: the stage in use is being used by the frame that is at work."""
        while self._built:
            stage = self._built.popleft()
            if self._stage is not None:
                stage.carry_on_from(self._stage)
            stage.set_slip(self._slip.value)
            self._stage = stage
            spare_the_collector()

    def _on_progress(self, step: str, share: float) -> None:
        if self._gone:
            raise CancelledError
        self._progress = f"{step}: {share:.0%}"

    def _on_surface(self, surface: Surface, header: Header) -> None:
        check_shape(surface.shape, self.sensor.pattern.shape)
        self._adopt_built()
        stage = self._stage
        if stage is None:
            self.diagnostics.passed_over += 1
            return
        # A controller that reads the wrench alone need not wait for more.
        self._number += 1
        whole = self._field.is_wanted or self._number % REPORTED_FRAME == 0
        field = stage.process(surface, stamp_ns(header.stamp), contacts=whole)
        # First what a controller waits for.
        self._wrench.publish(field, header)
        # Who has come meanwhile gets the next one, with contacts.
        if whole or not self._field.is_wanted:
            self._field.publish(field, header)
        self.frame_out(header)
        if whole:
            self._health.add(field)
        if self._points_publisher.get_subscription_count():
            grid = (field.rows, field.cols, 3)
            self._points_publisher.publish(
                conversions.organised_cloud(
                    header,
                    field.position.reshape(grid),
                    field.force.reshape(grid),
                    ("fx", "fy", "fz"),
                )
            )

    def _update_diagnostics(self) -> None:
        self._adopt_built()
        found, figures = self._health.close_period()
        ready, notes = self._stage is not None, [found.text]
        if self._one_view and ADVICE[ForceFlag.NO_DEPTH] not in found.text:
            notes.append(ADVICE[ForceFlag.NO_DEPTH])
        if self._stage is not None and self._stage.zeroed_load:
            load = self._stage.zeroed_load
            notes.insert(0, f"the reference was taken under a load of {load:.2f} N")
        text = "; ".join(filter(None, notes)) if ready else self._progress
        self.diagnostics.note = replace(found, text=text)
        waiting = "failed" if self.diagnostics.failure else "building"
        self.diagnostics.extra = {"model": "ready" if ready else waiting, **figures}


def main() -> int:
    """Entry point of `ros2 run cmp_tactile_processing force_reconstructor`."""
    return run_node(ForceReconstructor)


if __name__ == "__main__":
    sys.exit(main())
