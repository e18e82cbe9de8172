"""Node: shows surface and force as markers."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.dense_surface import SurfaceInterpolator, grid_over
from cmp_tactile_processing.nodes.conversions import force_field_from_msg, surface_from_msg
from cmp_tactile_processing.nodes.markers import MarkerParameters, force_markers, surface_markers
from cmp_tactile_processing.nodes.point_clouds import organised_cloud
from cmp_tactile_processing.nodes.process import run_node
from cmp_tactile_processing.nodes.stage_node import StageNode
from cmp_tactile_processing.nodes.stage_parameters import StageParameters
from cmp_tactile_processing.one_view import laid_on_known_surface
from cmp_tactile_processing.parameters import check_parameters, parameter

__all__ = ["DenseParameters", "SurfaceVisualizer"]


@dataclass(frozen=True)
class DenseParameters:
    """Nodes of the dense surface."""

    dense_spacing: float = parameter(
        2e-4, "distance between the points of dense_points", unit="m", low=2e-5, high=1e-2
    )
    dense_margin: float = parameter(
        0.0,
        "how far dense_points is extrapolated beyond the known markers",
        unit="m",
        low=0.0,
        high=1e-2,
    )

    def __post_init__(self) -> None:
        check_parameters(self, "dense surface")


class SurfaceVisualizer(StageNode):
    """Draws `surface` and `force_field` as `markers`, and fills `surface` up to `dense_points`.

    Each is made only while somebody subscribes to it.  `dense_points` is the surface on a grid
    that is regular where the gel is at rest: position, displacement and, as `status`, 0 missing,
    1 in a cell of four measured markers, 2 interpolated across lost or predicted ones,
    3 extrapolated, by `dense_margin` at most.
    Namespaces: `surface` (mesh coloured by indentation), `displacement`, `force` (arrows on the
    nodes in contact), and of each contact `contact` (outline), `resultant` (arrow that ends at the
    centre of pressure) and `contact_text` (normal force and its standard deviation, area, slip
    state).  Those of a contact have the colour of its slip state: green where it sticks, orange
    where it begins to slip, magenta where it slips, pale blue where that is not known.  Ids are 0,
    but for the texts of the up to 8 strongest contacts, 0 to 7.  What has nothing to show is
    deleted: without contact there is no arrow.
    Markers of a sensor with one view are drawn on its known surface; its clouds have no depth.
    Its parameters may be set while it runs.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("surface_visualizer", **node_kwargs)

    def _set_up(self) -> None:
        self._look = StageParameters(self, MarkerParameters(), lambda _: None)
        self._dense = StageParameters(self, DenseParameters(), self._prepare)
        self._prepare(self._dense.value)
        self._marker_publisher = self.add_publisher(MarkerArray, "markers")
        self._dense_publisher = self.add_publisher(PointCloud2, "dense_points")
        self.add_input(SurfaceMsg, "surface", self._on_surface)
        self.add_input(ForceFieldMsg, "force_field", self._on_force_field)

    def _prepare(self, options: DenseParameters) -> None:
        pattern, margin = self.sensor.pattern, options.dense_margin
        grid = grid_over(pattern.shape, pattern.pitch, options.dense_spacing, margin)
        self._interpolator = SurfaceInterpolator(pattern.shape, pattern.pitch, grid, margin)

    def _on_surface(self, msg: SurfaceMsg) -> None:
        drawn = self._marker_publisher.get_subscription_count() > 0
        filled = self._dense_publisher.get_subscription_count() > 0
        if not (drawn or filled):
            return
        surface = surface_from_msg(msg, self.sensor.pattern.shape)
        if drawn:
            shown = laid_on_known_surface(surface, self.sensor.pattern.surface)
            markers = surface_markers(shown, msg.header, self._look.value)
            self._marker_publisher.publish(MarkerArray(markers=markers))
        if filled:
            dense = self._interpolator.interpolate(surface)
            fields = dense.position, dense.displacement, ("dx", "dy", "dz"), dense.status
            self._dense_publisher.publish(organised_cloud(msg.header, *fields))
        self.frame_out(msg.header)

    def _on_force_field(self, msg: ForceFieldMsg) -> None:
        if self._marker_publisher.get_subscription_count():
            markers = force_markers(force_field_from_msg(msg), msg.header, self._look.value)
            self._marker_publisher.publish(MarkerArray(markers=markers))
            self.frame_out(msg.header)


def main() -> int:
    """Entry point of `ros2 run cmp_tactile_processing surface_visualizer`."""
    return run_node(SurfaceVisualizer)


if __name__ == "__main__":
    sys.exit(main())
