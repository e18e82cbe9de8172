"""Node: shows surface and force as markers."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from visualization_msgs.msg import Marker, MarkerArray

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.nodes.conversions import force_field_from_msg, surface_from_msg
from cmp_tactile_processing.nodes.markers import MarkerParameters, force_markers, surface_markers
from cmp_tactile_processing.nodes.process import run_node
from cmp_tactile_processing.nodes.stage_node import StageNode
from cmp_tactile_processing.nodes.stage_parameters import StageParameters

__all__ = ["SurfaceVisualizer"]


class SurfaceVisualizer(StageNode):
    """Draws `surface` and `force_field` as `markers`, only while somebody subscribes.

    Namespaces, each with the one id 0: `surface` (mesh coloured by indentation), `displacement`,
    `force` (arrows) and `contact` (outline).  A namespace with nothing to show is deleted.
    The gains may be set while it runs.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("surface_visualizer", **node_kwargs)

    def _set_up(self) -> None:
        self._look = StageParameters(self, MarkerParameters(), lambda _: None)
        self._marker_publisher = self.add_publisher(MarkerArray, "markers")
        self.add_input(SurfaceMsg, "surface", self._on_surface)
        self.add_input(ForceFieldMsg, "force_field", self._on_force_field)

    def _on_surface(self, msg: SurfaceMsg) -> None:
        self._publish(
            msg,
            lambda: surface_markers(
                surface_from_msg(msg, self.sensor.pattern.shape), msg.header, self._look.value
            ),
        )

    def _on_force_field(self, msg: ForceFieldMsg) -> None:
        self._publish(
            msg, lambda: force_markers(force_field_from_msg(msg), msg.header, self._look.value)
        )

    def _publish(self, msg: Any, draw: Callable[[], list[Marker]]) -> None:
        if self._marker_publisher.get_subscription_count():
            self._marker_publisher.publish(MarkerArray(markers=draw()))
            self.frame_out(msg.header)


def main() -> int:
    """Entry point of `ros2 run cmp_tactile_processing surface_visualizer`."""
    return run_node(SurfaceVisualizer)


if __name__ == "__main__":
    sys.exit(main())
