"""Markers show the surface and the force at their true places, and never a NaN."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from made_forces import made_contact, made_field
from rclpy.publisher import Publisher
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.measured import Contact, ForceField, SlipEstimate, SlipState, Surface
from cmp_tactile_processing.nodes.surface_visualizer import SurfaceVisualizer
from cmp_tactile_processing.ros.messages.conversions import force_field_to_msg, surface_to_msg
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.surface.dense import interpolate
from cmp_tactile_processing.surface.displacement import Reference, surface_at_rest

pytestmark = pytest.mark.ros

SENSOR = load_sensor("sample_rig")
PATTERN = SENSOR.pattern
SHAPE = PATTERN.shape
HEADER = Header(stamp=Time(sec=8), frame_id="sample_rig_gel_frame")
ROWS, COLS = SHAPE.corners
# As `Scene.show` names the lines of the texts of two contacts, three for each.
TEXT_NAMES = ["contact_text", *(f"contact_text {number}" for number in range(1, 6))]


def _surface(displacement: np.ndarray | float = 0.0, seen: np.ndarray | bool = True) -> Surface:
    reference = PATTERN.corners()
    displacement = np.broadcast_to(displacement, reference.shape)
    seen = np.broadcast_to(seen, SHAPE.corners)
    lost = np.where(seen, 0.0, np.nan)[..., None]
    return replace(
        surface_at_rest(Reference.nominal(SENSOR), SHAPE),
        position=reference + displacement + lost,
        displacement=displacement + lost,
        status=seen.astype(np.uint8),
        ray_gap=lost[..., 0],
    )


def _field(contact: np.ndarray, force: np.ndarray) -> ForceField:
    return made_field(
        ROWS,
        COLS,
        position=PATTERN.corners().reshape(-1, 3),
        force=force.reshape(-1, 3),
        contact=contact.ravel(),
        slip_state=SlipState.UNKNOWN,
    )


def _points(marker: Marker) -> np.ndarray:
    return np.array([[p.x, p.y, p.z] for p in marker.points]).reshape(-1, 3)


def _message(item: Surface | ForceField, header: Header) -> SurfaceMsg | ForceFieldMsg:
    if isinstance(item, Surface):
        return surface_to_msg(item, header)
    return force_field_to_msg(item, header)


class Scene:
    """A visualizer that draws with every message, and publishers to it."""

    def __init__(self, ros, **parameters) -> None:
        self.ros = ros
        parameters.setdefault("max_rate", 0.0)
        self.node = ros.start(SurfaceVisualizer, **parameters)
        self.arrays = ros.listen(MarkerArray, "markers")
        ros.wait_subscribed(self.node, "markers")
        self._publishers: dict[type, Publisher] = {
            SurfaceMsg: ros.publisher(SurfaceMsg, "surface"),
            ForceFieldMsg: ros.publisher(ForceFieldMsg, "force_field"),
        }

    def publish(self, *messages: SurfaceMsg | ForceFieldMsg) -> None:
        """Publish them, and wait until each is drawn."""
        count = len(self.arrays) + len(messages)
        for msg in messages:
            self._publishers[type(msg)].publish(msg)
        self.ros.wait(lambda: len(self.arrays) == count, "markers")

    def show(self, *data: Surface | ForceField) -> dict[str, Marker]:
        """What is drawn of one frame, by name."""
        self.publish(*(_message(item, HEADER) for item in data))
        return self.shown()

    def shown(self) -> dict[str, Marker]:
        """What the last message shows, by name."""
        first, *markers = self.arrays[-1].markers
        assert first.action == Marker.DELETEALL
        assert len({(marker.ns, marker.id) for marker in markers}) == len(markers)
        for marker in markers:
            assert marker.action == Marker.ADD
            assert marker.id == 0 or marker.ns in ("contact_text", "legend")
            assert marker.header == HEADER
            assert np.isfinite(_points(marker)).all()
            assert marker.text if marker.type == Marker.TEXT_VIEW_FACING else marker.points
        return {marker.ns + (f" {marker.id}" if marker.id else ""): marker for marker in markers}


def test_mesh_spans_the_markers_and_leaves_out_the_missing(ros):
    seen = np.ones(SHAPE.corners, bool)
    seen[5, 9] = False
    mesh = Scene(ros).show(_surface(seen=seen))["surface"]
    assert mesh.type == Marker.TRIANGLE_LIST
    triangles = _points(mesh).reshape(-1, 3, 3)
    # One missing inner corner takes its four cells, of two triangles each.
    assert len(triangles) == 2 * ((ROWS - 1) * (COLS - 1) - 4)
    edges = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert (edges[:, 2] > 0).all(), "all triangles face out of the gel"
    cell_area = PATTERN.pitch**2
    assert np.abs(edges[:, 2] / 2).sum() == pytest.approx(
        cell_area * ((ROWS - 1) * (COLS - 1) - 4), rel=1e-5
    )
    corners = PATTERN.corners().astype(np.float32)[seen]
    used = np.unique(_points(mesh).astype(np.float32), axis=0)
    np.testing.assert_array_equal(used, np.unique(corners, axis=0))


def test_a_surface_without_depth_is_drawn_flat(ros):
    """As one view measures it."""
    markers = Scene(ros).show(_surface(np.array([1e-4, 0.0, np.nan])))
    # Two triangles a cell; the ends of a shaft and two barbs an arrow.
    assert len(markers["surface"].points) == 6 * (ROWS - 1) * (COLS - 1)
    assert len(markers["displacement"].points) == 6 * ROWS * COLS


def test_mesh_colour_shows_the_indentation(ros):
    displacement = np.zeros((ROWS, COLS, 3))
    displacement[:, 10:, 2] = -0.0005
    displacement[:, 15:, 2] = -0.002
    mesh = Scene(ros, depth_range=0.001).show(_surface(displacement))["surface"]
    assert len(mesh.colors) == len(mesh.points)
    colours = np.array([[c.r, c.g, c.b] for c in mesh.colors])
    column = np.round(_points(mesh)[:, 0] / PATTERN.pitch + (COLS - 1) / 2).astype(int)
    # Ends and middle of viridis: dark violet, teal, yellow.
    for where, colour in (
        (column < 10, (0.27, 0.0, 0.33)),
        ((column >= 10) & (column < 15), (0.13, 0.57, 0.55)),
        (column >= 15, (0.99, 0.91, 0.14)),
    ):
        np.testing.assert_allclose(
            colours[where], np.broadcast_to(colour, (where.sum(), 3)), atol=0.03
        )


def test_arrows_run_from_reference_along_the_displacement_times_gain(ros):
    displacement = np.zeros((ROWS, COLS, 3))
    displacement[2, 3] = 1e-4, 2e-4, -3e-4
    displacement[8, 8] = 0, 0, -1e-4
    scene = Scene(ros, displacement_gain=2.0)
    marker = scene.show(_surface(displacement))["displacement"]
    assert marker.type == Marker.LINE_LIST
    shafts = _points(marker).reshape(2, 3, 2, 3)[:, 0]
    reference = PATTERN.corners()
    for (tail, tip), (i, j) in zip(shafts, ((2, 3), (8, 8)), strict=True):
        np.testing.assert_allclose(tail, reference[i, j], atol=1e-8)
        np.testing.assert_allclose(tip - tail, 2 * displacement[i, j], atol=1e-8)
    heads = _points(marker).reshape(2, 3, 2, 3)[:, 1:]
    lengths = np.linalg.norm(heads[..., 1, :] - heads[..., 0, :], axis=-1)
    whole = np.linalg.norm(shafts[:, 1] - shafts[:, 0], axis=-1, keepdims=True)
    np.testing.assert_allclose(lengths / whole, np.hypot(0.25, 0.1), rtol=1e-3)


def _square(middle: tuple[float, float, float], half: float) -> np.ndarray:
    around = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    return np.array(middle) + half * around


def _contact(slip: SlipEstimate, middle: tuple[float, float, float], **changes) -> Contact:
    given = {
        "wrench": np.array([0.5, 0.0, -4.0, 0.0, 0.0, 0.0]),
        "covariance": np.diag([4e-4, 4e-4, 9e-4, 0, 0, 0]),
        "area": 1.25e-5,
        "centre_of_pressure": np.array(middle),
        "outline": _square(middle, 2e-3),
    }
    return made_contact([0, 1, 2], slip=slip, **{**given, **changes})


def _pressed(*contacts: Contact) -> ForceField:
    inside = np.zeros(SHAPE.corners, bool)
    inside[4:9, 6:12] = True
    force = np.zeros((ROWS, COLS, 3))
    force[inside] = 0, 0, -0.02
    # What the noise leaves beside a contact.
    force[0] = 0, 0, 0.01
    return replace(_field(inside, force), contacts=contacts)


def test_force_arrows_end_at_the_nodes_in_contact_and_nowhere_else(ros):
    field = _pressed()
    markers = Scene(ros, force_gain=0.1).show(field)
    shafts = _points(markers["force"]).reshape(-1, 3, 2, 3)[:, 0]
    assert len(shafts) == field.contact.sum()
    np.testing.assert_allclose(
        shafts[:, 1] - shafts[:, 0], np.broadcast_to((0, 0, -0.002), (len(shafts), 3)), atol=1e-8
    )
    np.testing.assert_allclose(shafts[:, 1], field.position[field.contact], atol=1e-8)


def test_each_contact_has_its_outline_resultant_and_text_in_the_colour_of_its_slip(ros):
    sticks = _contact(SlipEstimate(SlipState.STICK), (1e-3, 2e-3, -1e-4))
    slips = _contact(
        SlipEstimate(SlipState.FULL),
        (-4e-3, 0.0, 0.0),
        at_border=True,
        covariance=np.full((6, 6), np.nan),
    )
    markers = Scene(ros, resultant_gain=0.002, text_size=0.001).show(_pressed(sticks, slips))
    colours = {"sticks": (0.2, 1.0, 0.2), "slips": (1.0, 0.1, 0.5)}
    sides = _points(markers["contact"]).reshape(2, 4, 2, 3)
    arrows = _points(markers["resultant"]).reshape(2, 3, 2, 3)
    for number, (contact, word) in enumerate(((sticks, "sticks"), (slips, "slips"))):
        np.testing.assert_allclose(sides[number, :, 0], contact.outline, atol=1e-8)
        np.testing.assert_array_equal(sides[number, :, 1], np.roll(sides[number, :, 0], -1, axis=0))
        tail, tip = arrows[number, 0]
        np.testing.assert_allclose(tip, contact.centre_of_pressure, atol=1e-8)
        np.testing.assert_allclose(tip - tail, (0.001, 0, -0.008), atol=1e-8)
        for name, part in (("contact", 8), ("resultant", 6)):
            drawn = [(c.r, c.g, c.b) for c in markers[name].colors[number * part :][:part]]
            np.testing.assert_allclose(drawn, np.tile(colours[word], (part, 1)), atol=1e-6)
    edge = max(_points(markers["resultant"])[:, 1].max(), PATTERN.corners()[..., 1].max())
    first = [markers[name] for name in TEXT_NAMES[:3]]
    assert [line.text for line in first] == ["Fz -4.00 +/- 0.03 N", "12.5 mm^2", "sticks"]
    second = [markers[name].text for name in TEXT_NAMES[3:6]]
    assert second == ["Fz -4.00 N", "12.5 mm^2, at the border", "slips"]
    assert first[1].pose.position.x == pytest.approx(1e-3)
    for line in first:
        assert line.type == Marker.TEXT_VIEW_FACING
        assert line.pose.position.y > edge, "beyond gel and arrows, where it can be read"
        # A space is half of x wide in RViz, and 0.7 m where x is 0.
        assert (line.scale.x, line.scale.y, line.scale.z) == (0.001, 0.0, 0.001)


@pytest.mark.parametrize(
    "force",
    [np.nan, np.random.default_rng(0).normal(size=(ROWS, COLS, 3)) * 0.05],
    ids=["unknown", "noise on nodes without contact"],
)
def test_of_nothing_to_show_there_is_no_marker(ros, force):
    """RViz reports an empty list as an error."""
    nowhere = np.zeros(SHAPE.corners, bool)
    field = _field(nowhere, np.broadcast_to(force, (ROWS, COLS, 3)))
    markers = Scene(ros).show(_surface(seen=nowhere), field)
    assert {marker.ns for marker in markers.values()} == {"legend"}


def test_the_newest_surface_and_force_are_drawn_unless_one_of_them_is_old(ros):
    """A force that comes no more, as while its model is built again, is not of this surface."""
    scene = Scene(ros)
    force, surface = _message(_pressed(), HEADER), _message(_surface(), HEADER)
    for message, names in (
        (force, {"force"}),
        (surface, {"force", "surface", "legend"}),
        (_message(_surface(), Header(stamp=Time(sec=10), frame_id="later")), {"surface", "legend"}),
    ):
        scene.publish(message)
        first, *markers = scene.arrays[-1].markers
        assert {marker.ns for marker in markers} == names
        assert all(marker.header == message.header for marker in (first, *markers))


def test_nothing_is_computed_while_nobody_looks_and_markers_vanish_if_not_renewed(ros):
    node = ros.start(SurfaceVisualizer, lifetime=1.5)
    publisher = ros.publisher(SurfaceMsg, "surface")
    surface = _surface()
    # Would be refused if it were read.
    publisher.publish(surface_to_msg(replace(surface, status=surface.status * 7), HEADER))
    ros.wait(lambda: node.diagnostics.frames_in == 1, "the surface")
    assert (node.diagnostics.sent.frames, node.diagnostics.bad_frames) == (0, 0)
    arrays = ros.listen(MarkerArray, "markers")
    ros.wait_subscribed(node, "markers")
    publisher.publish(surface_to_msg(surface, HEADER))
    ros.wait(lambda: arrays, "markers")
    lifetimes = {(m.lifetime.sec, m.lifetime.nanosec) for m in arrays[0].markers[1:]}
    assert lifetimes == {(1, 500_000_000)}
    assert all(marker.frame_locked for marker in arrays[0].markers), "they move with the finger"


def test_moment_is_drawn_about_the_contacts_own_centre(ros):
    """Of a force beside the origin nothing is left there but the torsion, and its sense shows."""
    centre, torsion = (2e-3, -1e-3, 0.0), np.array([0.0, 0.0, -5e-3])
    force = np.array([0.5, 0.2, -4.0])
    contact = _contact(
        SlipEstimate(SlipState.STICK),
        centre,
        wrench=np.concatenate([force, np.cross(centre, force) + torsion]),
    )
    scene = Scene(ros, moment_gain=0.6)
    marker = scene.show(_pressed(contact))["moment"]
    lines = _points(marker).reshape(-1, 2, 3)
    tail, tip = lines[0]
    np.testing.assert_allclose(tip - tail, 0.6 * torsion, atol=1e-9)
    np.testing.assert_allclose(tip, centre, atol=1e-9)
    arc = lines[3:-2] - np.array(centre)
    swept = np.cross(arc[:, 0], arc[:, 1])
    assert (swept[:, 2] < 0).all(), "clockwise as seen from outside: the moment is into the gel"
    np.testing.assert_allclose(arc[..., 2], 0.5 * 3e-3, atol=1e-9)
    level = replace(contact, wrench=np.concatenate([force, np.cross(centre, force)]))
    assert "moment" not in scene.show(_pressed(level))


def test_legend_shows_the_range_of_depth_and_the_scales_and_can_be_switched_off(ros):
    surface = _surface()
    scene = Scene(ros, depth_range=0.0015, force_gain=0.02)
    markers = scene.show(surface)
    bar = markers["legend"]
    place, colours = _points(bar), np.array([[c.r, c.g, c.b] for c in bar.colors])
    assert place[:, 0].min() > PATTERN.corners()[..., 0].max(), "beside the gel"
    order = np.argsort(place[:, 1], kind="stable")
    assert colours[order[0]] == pytest.approx((0.27, 0.0, 0.33), abs=0.03)
    assert colours[order[-1]] == pytest.approx((0.99, 0.91, 0.14), abs=0.03)
    assert (markers["legend 1"].text, markers["legend 2"].text) == ("0", "1.5 mm deep")
    assert [markers[f"legend {number}"].text for number in (3, 4, 5, 6)] == [
        "white: displacement x 1",
        "red: force at a node, 0.1 N = 2 mm",
        "thick: force of a contact, 1 N = 1 mm",
        "with an arc: its moment, 10 N mm = 5 mm",
    ]
    (answer,) = ros.set_parameters("surface_visualizer", {"legend": False})
    assert answer.successful
    ros.wait(lambda: len(scene.arrays) == 2, "the surface without a legend")
    assert set(scene.shown()) == {"surface"}


def _read_cloud(cloud: PointCloud2) -> np.ndarray:
    """As any reader would: by the fields of the message."""
    kinds = {PointField.FLOAT32: "<f4", PointField.UINT8: "u1"}
    layout = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [kinds[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    assert cloud.row_step == cloud.width * cloud.point_step
    assert cloud.point_step % 4 == 0
    return np.frombuffer(cloud.data, layout).reshape(cloud.height, cloud.width)


def test_dense_points_are_those_of_the_core(ros):
    """That these are right: surface/test_dense.py.  A lost corner is bridged, the rim marked."""
    spacing, margin = PATTERN.pitch / 4, PATTERN.pitch / 2
    node = ros.start(SurfaceVisualizer, dense_spacing=spacing, dense_margin=margin)
    clouds = ros.listen(PointCloud2, "dense_points")
    ros.wait_subscribed(node, "dense_points")
    seen = np.ones(SHAPE.corners, bool)
    seen[5, 9] = False
    x, y, _ = np.moveaxis(PATTERN.corners(), -1, 0)
    surface = _surface(np.stack([0.05 * x, 1e-4 + 0 * y, 0.02 * y - 3e-4], axis=-1), seen)
    ros.publisher(SurfaceMsg, "surface").publish(surface_to_msg(surface, HEADER))
    ros.wait(lambda: clouds, "dense points")
    (cloud,) = clouds
    assert cloud.header == HEADER
    assert cloud.is_dense
    points, expected = _read_cloud(cloud), interpolate(surface, spacing, margin)
    np.testing.assert_array_equal(points["status"], expected.status)
    for axis, name in enumerate("xyz"):
        # float32 of lengths up to 0.01 m.
        np.testing.assert_allclose(points[name], expected.position[..., axis], atol=2e-9)
        moved = expected.displacement[..., axis]
        np.testing.assert_allclose(points[f"d{name}"], moved, atol=2e-9)
    assert node.diagnostics.sent.frames == 1
