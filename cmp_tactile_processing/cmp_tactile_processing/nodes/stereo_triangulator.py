"""Node: triangulates the grids of the two views and determines the displacement."""

from __future__ import annotations

import math
import sys
import threading
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from cmp_tactile_msgs.msg import Grid as GridMsg
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.errors import CalibrationError, Finding, Severity
from cmp_tactile_processing.measured import Grid, Markers3D, measured_share
from cmp_tactile_processing.nodes.health import reference_figures
from cmp_tactile_processing.ros.base_nodes import Answer, FrameService, StageNode
from cmp_tactile_processing.ros.messages import conversions
from cmp_tactile_processing.ros.messages.making import gel_frame
from cmp_tactile_processing.ros.messages.reading import grid_from_msg, stamp_ns
from cmp_tactile_processing.ros.parameters import StageParameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.ros.services import SERVICE_S
from cmp_tactile_processing.sensor.parameters import Parameters, TriangulationParameters, parameter
from cmp_tactile_processing.stereo.rig import StereoRig, implausible_ray_gap
from cmp_tactile_processing.surface import reference_keeping
from cmp_tactile_processing.surface.displacement import Reference, surface_at_rest
from cmp_tactile_processing.surface.gauge import RestGauge
from cmp_tactile_processing.surface.stillness import RestParameters

ANSWER_S = 60.0


@dataclass(frozen=True)
class ReferenceParameters(Parameters, section="reference"):
    """From what the service takes the reference of the displacement."""

    reference_frames: int = parameter(
        10, "number of frames that a reference averages", within=(1, 1000)
    )
    reference_timeout: float = parameter(
        10.0, "time after which taking a reference fails", unit="s", within=(0.1, 3600.0)
    )


class StampPairing:
    """Holds what still waits for its partner, at most `capacity` items a side.

    Partners may come late, in any order, or never: an item is given up (and counted in
    `unpaired`) only when the buffer of its side is full or the same stamp comes again.
    """

    def __init__(self, sides: tuple[str, str], capacity: int = 20) -> None:
        self._capacity = capacity
        self._waiting: dict[str, dict[int, Any]] = {side: {} for side in sides}
        self._partner = dict(zip(sides, reversed(sides), strict=True))
        self._sides = sides
        self.unpaired = dict.fromkeys(sides, 0)

    def add(self, side: str, stamp_ns: int, item: Any) -> tuple[Any, Any] | None:
        """The pair that the item completes, in the order of `sides`, or None while it waits."""
        partner = self._waiting[self._partner[side]].pop(stamp_ns, None)
        if partner is not None:
            return (item, partner) if side == self._sides[0] else (partner, item)
        waiting = self._waiting[side]
        if waiting.pop(stamp_ns, None) is not None:
            self.unpaired[side] += 1
        elif len(waiting) == self._capacity:
            waiting.pop(next(iter(waiting)))
            self.unpaired[side] += 1
        waiting[stamp_ns] = item
        return None

    def forget(self, side: str) -> None:
        """Give up what waits on a side."""
        self.unpaired[side] += len(self._waiting[side])
        self._waiting[side].clear()


class StereoTriangulator(StageNode):
    """Turns `left/grid` and `right/grid` of equal stamp into `surface`.

    A sensor with one view has one grid, and its surface no depth.  Displacement refers to the
    nominal surface of the sensor description until a reference is taken.  The node takes it when
    the gel is still and nothing seems to touch it (`auto_reference`), or when the service
    `~/set_reference` is called, which first has the trackers inspect the print, as
    `Pipeline.set_reference` does.  `reference` (latched) is the surface that displacement refers
    to.  The diagnostics warn, with the reason, while there is no reference, and of drift of the gel
    at rest (docs/reference.md).  `surface_points` is made only while somebody subscribes.
    """

    default_name = "stereo_triangulator"

    def _set_up(self) -> None:
        self._build_rig(StageParameters(self, self.sensor.triangulation, self._build_rig).value)
        gauge = RestGauge(self.sensor)
        self._keeper = reference_keeping.ReferenceKeeper(Reference.nominal(self.sensor), gauge)
        threading.Thread(target=gauge.prepare, name="gauge", daemon=True).start()
        self._pairing = StampPairing(("left", "right"))
        # Of the last second: why its frames are implausible, and of the last frame.
        self._doubt, self._tracked = "", math.nan
        self._options = StageParameters(self, ReferenceParameters(), lambda _: None)
        self._keeper.zero(
            StageParameters(self, reference_keeping.ZeroParameters(), self._keeper.zero).value
        )
        self._rest = StageParameters(self, RestParameters(), self._watch)
        self._drift = StageParameters(self, reference_keeping.DriftParameters(), self._watch)
        self._watch()
        self._frame = gel_frame(self.sensor)
        self._surface = self.add_result(SurfaceMsg, "surface", conversions.surface_to_msg)
        self._points_publisher = self.add_publisher(PointCloud2, "surface_points")
        self._reference_publisher = self.add_publisher(SurfaceMsg, "reference", 1, latched=True)
        self._publish_reference(self.get_clock().now().to_msg())
        read = partial(grid_from_msg, shape=self.sensor.pattern.shape)
        for view in self.sensor.views:
            self.add_input(GridMsg, f"{view}/grid", partial(self._on_grid, view), read)
        self._averaging = FrameService[Markers3D](
            self,
            "~/set_reference",
            "a reference is already being taken",
            self._wanted_for_reference,
            before=self._inspect_print,
        )
        self._trackers: dict[str, Client[Any, Any]] = {}

    def _build_rig(self, parameters: TriangulationParameters) -> None:
        self._rig = StereoRig(replace(self.sensor, triangulation=parameters))

    def _watch(self, _changed: object = None) -> None:
        self._keeper.watch(self._rest.value, self._drift.value)

    def _on_grid(self, view: str, grid: Grid, header: Header) -> None:
        if len(self.sensor.views) == 1:
            self._on_grids({view: grid}, header.stamp)
            return
        pair = self._pairing.add(view, stamp_ns(header.stamp), grid)
        if pair is not None:
            self._on_grids({"left": pair[0], "right": pair[1]}, header.stamp)

    def _start_again(self, topic: str) -> None:
        # What waits there may have the stamp of a frame that is still to come.
        self._pairing.forget(topic.partition("/")[0])

    def _on_grids(self, grids: dict[str, Grid], stamp: Any) -> None:
        markers = self._rig.triangulate(
            grids.get("left"), grids.get("right"), virtual_markers=self._surface.is_wanted
        )
        # It may be a new reference that this displacement is against.
        self._keep_reference(markers, stamp)
        surface = self._keeper.reference.surface(markers)
        header = conversions.header_at(stamp, self._frame)
        self._surface.publish(surface, header)
        self.frame_out(header)
        self._check(markers)
        if self._points_publisher.get_subscription_count():
            self._points_publisher.publish(
                conversions.organised_cloud(
                    header, surface.position, surface.displacement, ("dx", "dy", "dz")
                )
            )

    def _check(self, markers: Markers3D) -> None:
        doubt = implausible_ray_gap(markers.ray_gap, markers.status, self.sensor.name)
        if doubt:
            self.warn(self._surface.topic_name, doubt)
            self._doubt = doubt
        self._tracked = measured_share(markers.status)

    def _keep_reference(self, markers: Markers3D, stamp: Any) -> None:
        collected = self._averaging.take(markers)
        if collected is not None:
            self._take_reference(*collected, stamp)
            return
        said = self._keeper.add(markers, stamp_ns(stamp))
        if said:
            self.get_logger().info(said)
            self._publish_reference(stamp)

    def _take_reference(self, frames: list[Markers3D], finish: Answer, stamp: Any) -> None:
        try:
            explanation = self._keeper.take(frames, stamp_ns(stamp))
        except CalibrationError as error:
            self.get_logger().warning(f"no new reference: {error}")
            finish(False, str(error))
            return
        self._publish_reference(stamp)
        self.get_logger().info(explanation)
        finish(True, explanation)

    def _publish_reference(self, stamp: Any) -> None:
        surface = surface_at_rest(self._keeper.reference, self.sensor.pattern.shape)
        header = conversions.header_at(stamp, self._frame)
        self._reference_publisher.publish(conversions.surface_to_msg(surface, header))

    async def _inspect_print(self) -> str:
        """Have the nodes that publish the grids inspect the print; why one could not, or empty.

        Those without such a service, as a replay of grids, know nothing of the print.
        """
        asked = [
            client.call_async(Trigger.Request())
            for view in self.sensor.views
            for node in self.get_publishers_info_by_topic(self.resolve_topic_name(f"{view}/grid"))
            if (client := self._tracker(node.node_name, node.node_namespace)) is not None
        ]

        def give_up() -> None:
            for future in asked:
                future.cancel()

        # A tracker that has ended never answers.
        timer = self.create_steady_timer(ANSWER_S, give_up)
        answers = [await future for future in asked]
        self.destroy_timer(timer)
        if None in answers:
            return f"the print was not inspected within {ANSWER_S:g} s"
        return next((answer.message for answer in answers if not answer.success), "")

    def _tracker(self, name: str, namespace: str) -> Client[Any, Any] | None:
        """The client of a node's service inspect_print; None where it has none."""
        service = f"{namespace.rstrip('/')}/{name}/inspect_print"
        if service not in dict(self.get_service_names_and_types()):
            return None
        if service not in self._trackers:
            group = ReentrantCallbackGroup()
            self._trackers[service] = self.create_client(Trigger, service, callback_group=group)
        client = self._trackers[service]
        # The graph knows the service, so this is soon over.
        return client if client.wait_for_service(SERVICE_S) else None

    def _wanted_for_reference(self) -> tuple[int, float, str]:
        topics = " and ".join(self.resolve_topic_name(f"{v}/grid") for v in self.sensor.views)
        return self._options.value.reference_frames, self._options.value.reference_timeout, topics

    def _update_diagnostics(self) -> None:
        text, self._doubt = self._doubt or self._keeper.warning(), ""
        self.diagnostics.note = Finding(Severity.WARNING, text)
        self.diagnostics.extra = {
            "tracked fraction": f"{self._tracked:.4f}",
            "unpaired grids": sum(self._pairing.unpaired.values()),
            **reference_figures(self._keeper),
        }


def main() -> int:
    """Entry point of `ros2 run cmp_tactile_processing stereo_triangulator`."""
    return run_node(StereoTriangulator)


if __name__ == "__main__":
    sys.exit(main())
