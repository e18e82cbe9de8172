"""Node: shows surface and force as markers."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.measured import NS_PER_S, ForceField, Surface
from cmp_tactile_processing.ros import rviz
from cmp_tactile_processing.ros.base_nodes import StageNode
from cmp_tactile_processing.ros.messages import reading
from cmp_tactile_processing.ros.messages.conversions import organised_cloud
from cmp_tactile_processing.ros.parameters import StageParameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.ros.rviz_markers import MarkerParameters, force_markers, surface_markers
from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_processing.surface.dense import SurfaceInterpolator, grid_over
from cmp_tactile_processing.surface.displacement import laid_on_known_surface

# What came of the other topic is drawn beside the newest message for so long, by their stamps.
KEPT_NS = NS_PER_S


@dataclass(frozen=True)
class Shown:
    """A surface or a force field, and the header of its frame."""

    value: Surface | ForceField
    header: Header

    @property
    def stamp_ns(self) -> int:
        """Of its frame."""
        return reading.stamp_ns(self.header.stamp)


@dataclass(frozen=True)
class DenseParameters(Parameters, section="dense surface"):
    """Nodes of the dense surface."""

    dense_spacing: float = parameter(
        2e-4, "distance between the points of dense_points", unit="m", within=(2e-5, 1e-2)
    )
    dense_margin: float = parameter(
        0.0,
        "how far dense_points extends beyond the known markers",
        unit="m",
        within=(0.0, 1e-2),
    )


class SurfaceVisualizer(StageNode):
    """Draws `surface` and `force_field` as `markers`, and fills `surface` up to `dense_points`.

    Each is made only while somebody subscribes, markers at most `max_rate` times a second.

    `dense_points` is the surface on a grid that is regular where the gel is at rest, with position,
    displacement and `status`: 0 missing, 1 in a cell of four measured markers, 2 interpolated
    across lost or predicted markers, 3 extrapolated, by at most `dense_margin`.

    Namespaces of markers: `surface` (mesh coloured by indentation), `displacement`, `legend`,
    `force` (arrows on the nodes in contact), and for each contact `contact` (outline), `resultant`
    (arrow that ends at the centre of pressure), `moment` (about the centre of pressure) and
    `contact_text` (normal force and its standard deviation, area, slip state).  A contact has the
    colour of its slip state: green sticks, orange begins to slip, magenta slips, pale blue unknown.
    Ids are 0; texts have one id for each line.  Each message begins with DELETEALL and is complete:
    it has the newest surface, and the newest force unless their stamps differ by more than a
    second.  Markers vanish after `lifetime` if they are not drawn again.

    Markers of a sensor with one view are drawn on its known surface; its clouds have no depth.
    Parameters may change while the node runs; the markers are then drawn again at once.
    """

    default_name = "surface_visualizer"

    def _set_up(self) -> None:
        # The newest of each topic, what came last at the end.
        self._shown: dict[str, Shown] = {}
        self._look = StageParameters(self, MarkerParameters(), self._draw_again)
        self._rate = rviz.DrawingRate(self, self._draw, self._look.value.max_rate)
        self._dense = StageParameters(self, DenseParameters(), self._prepare)
        self._prepare(self._dense.value)
        self._marker_publisher = self.add_publisher(MarkerArray, "markers")
        self._dense_publisher = self.add_publisher(PointCloud2, "dense_points")
        self.add_input(
            SurfaceMsg,
            "surface",
            self._on_surface,
            self._read_surface,
            needs_all=self._needs_surface,
        )
        self.add_input(
            ForceFieldMsg,
            "force_field",
            self._on_force,
            self._read_force,
            needs_all=self._anybody_looks,
        )

    def _prepare(self, options: DenseParameters) -> None:
        pattern, margin = self.sensor.pattern, options.dense_margin
        grid = grid_over(pattern.shape, pattern.pitch, options.dense_spacing, margin)
        self._interpolator = SurfaceInterpolator(pattern.shape, pattern.pitch, grid, margin)

    def _read_surface(self, msg: SurfaceMsg) -> Surface | None:
        if not self._needs_surface():
            return None
        return reading.surface_from_msg(msg, self.sensor.pattern.shape)

    def _read_force(self, msg: ForceFieldMsg) -> ForceField | None:
        return reading.force_field_from_msg(msg) if self._anybody_looks() else None

    def _on_surface(self, surface: Surface | None, header: Header) -> None:
        if surface is None:
            self._shown = {}
            return
        reading.check_shape(surface.shape, self.sensor.pattern.shape)
        self._show("surface", Shown(surface, header))
        if self._dense_publisher.get_subscription_count():
            dense = self._interpolator.interpolate(surface)
            fields = dense.position, dense.displacement, ("dx", "dy", "dz"), dense.status
            self._dense_publisher.publish(organised_cloud(header, *fields))
            self.frame_out(header)

    def _on_force(self, field: ForceField | None, header: Header) -> None:
        if field is not None:
            self._show("force_field", Shown(field, header))

    def _needs_surface(self) -> bool:
        return self._anybody_looks() or self._dense_publisher.get_subscription_count() > 0

    def _anybody_looks(self) -> bool:
        return self._marker_publisher.get_subscription_count() > 0

    def _start_again(self, topic: str) -> None:
        self._shown.pop(topic, None)

    def _show(self, topic: str, shown: Shown) -> None:
        if not self._anybody_looks():
            self._shown = {}
            return
        surface = self._shown.get("surface")
        self._shown.pop(topic, None)
        self._shown[topic] = shown
        # In a container a frame's force comes before its surface, and is drawn with that.
        if topic == "surface" or surface is None or not _follows(shown, surface):
            self._rate.request()

    def _draw_again(self, look: MarkerParameters) -> None:
        self._rate.limit(look.max_rate)
        if self._shown:
            self._rate.request()

    def _draw(self) -> None:
        if not (self._shown and self._anybody_looks()):
            return
        newest = next(reversed(self._shown.values()))
        markers: list[rviz.DrawnMarker] = []
        for topic, shown in self._shown.items():
            if abs(shown.stamp_ns - newest.stamp_ns) <= KEPT_NS:
                # What cannot be drawn is reported as a message that cannot be used.
                name = self.resolve_topic_name(topic)
                self._run_guarded(name, lambda each: markers.extend(self._markers(each)), shown)
        if markers:
            lifetime = self._look.value.lifetime
            data = rviz.marker_array_bytes(markers, newest.header, lifetime)
            self._marker_publisher.publish(data)
            self.frame_out(newest.header)

    def _markers(self, shown: Shown) -> list[rviz.DrawnMarker]:
        look, value = self._look.value, shown.value
        if isinstance(value, Surface):
            return surface_markers(laid_on_known_surface(value, self.sensor.pattern.surface), look)
        return force_markers(value, look)


def _follows(later: Shown, earlier: Shown) -> bool:
    """Whether it is of a later frame, by so little that both may be on show."""
    return 0 < later.stamp_ns - earlier.stamp_ns <= KEPT_NS


def main() -> int:
    """Entry point of `ros2 run cmp_tactile_processing surface_visualizer`."""
    return run_node(SurfaceVisualizer)


if __name__ == "__main__":
    sys.exit(main())
