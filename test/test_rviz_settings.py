"""The settings of RViz ask for topics that the nodes publish, and show what can be read.

RViz shows nothing of a topic that is not there, without a word.
"""

import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import yaml
from made_forces import made_contact, made_field

pytest.importorskip("rclpy")


from markers import look_of, mounts, moved
from rviz_view import View, picture_px, read_settings, text_box

from cmp_tactile_bringup.graphs.packaged import load_graph
from cmp_tactile_processing.measured import SlipEstimate, SlipState
from cmp_tactile_processing.ros.messages.making import gel_frame
from cmp_tactile_processing.ros.rviz.markers import (
    force_markers,
    surface_markers,
)
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.surface.displacement import Reference, surface_at_rest

ROOT = Path(__file__).parents[1]
# Files, their frame and the namespaces that they show.
FILES = {
    "cmp_tactile.rviz": ("sample_rig_gel_frame", {"sample_rig"}),
    "gripper.rviz": ("gripper", {"left_finger", "right_finger"}),
}
TYPES = {
    "MarkerArray": "visualization_msgs/MarkerArray",
    "Wrench": "geometry_msgs/WrenchStamped",
    "PointCloud2": "sensor_msgs/PointCloud2",
    "Image": "sensor_msgs/Image",
}
# Of lines of text, and of the picture that each gel covers where one or two are shown.
LEAST_TEXT_PX = 12
LEAST_SHARES = {"cmp_tactile.rviz": {1: 0.2}, "gripper.rviz": {1: 0.15, 2: 0.04}}


@pytest.fixture(params=FILES)
def name(request):
    return str(request.param)


@pytest.fixture
def settings(name):
    path = ROOT / "cmp_tactile_bringup" / "rviz" / name
    return dict(yaml.safe_load(path.read_text(encoding="utf-8")))


def _displays(group):
    for display in group["Displays"]:
        if display["Class"] == "rviz_common/Group":
            assert set(display) == {"Class", "Displays", "Enabled", "Name"}
            yield from _displays(display)
        else:
            package, kind = display["Class"].split("/")
            assert package == "rviz_default_plugins"
            yield kind, display


def _published():
    """Types of the topics that the nodes publish, by name below the sensor's namespace."""
    text = (ROOT / "docs" / "nodes.md").read_text(encoding="utf-8")
    found = dict(re.findall(r"^\| out \| `([^`]+)` \| ([^ ]+) \|", text, re.MULTILINE))
    # The table shows the tracker of the left view.
    return found | {
        topic.replace("left/", "right/"): kind
        for topic, kind in found.items()
        if topic.startswith("left/")
    }


def test_every_topic_is_published_with_the_type_of_its_display(name, settings):
    published, namespaces = _published(), FILES[name][1]
    shown = {}
    for kind, display in _displays(settings["Visualization Manager"]):
        if "Topic" not in display:
            continue
        namespace, topic = display["Topic"]["Value"].removeprefix("/").split("/", 1)
        assert published[topic] == TYPES[kind]
        # Images are large: of a best-effort subscription most are lost.
        assert display["Topic"]["Reliability Policy"] == "Reliable"
        shown.setdefault(namespace, set()).add(topic)
    assert set(shown) == namespaces
    for topics in shown.values():
        assert topics >= {"markers", "wrench", "left/grid_overlay", "right/grid_overlay"}
        assert topics >= {f"{name}_points" for name in ("surface", "dense", "force")}


def test_everything_is_shown_in_one_frame_that_is_there(name, settings):
    frame = FILES[name][0]
    manager = settings["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == frame
    assert manager["Views"]["Current"]["Target Frame"] == frame
    grids = [display for kind, display in _displays(manager) if kind == "Grid"]
    assert [grid["Reference Frame"] for grid in grids] == [frame]
    if name == "cmp_tactile.rviz":
        assert frame == gel_frame(load_sensor("sample_rig"))


def _shown(name, *contacts):
    """What the visualizer of each sensor of a graph draws at rest with these contacts."""
    graph = load_graph("gripper") if name == "gripper.rviz" else load_graph("simulate")
    sensor = load_sensor("sample_rig")
    surface = surface_at_rest(Reference.nominal(sensor), sensor.pattern.shape)
    nodes = sensor.pattern.corners()
    force = np.zeros_like(nodes)
    force[4:9, 6:12, 2] = -0.05
    field = made_field(
        *nodes.shape[:2],
        position=nodes.reshape(-1, 3),
        force=force.reshape(-1, 3),
        contact=force[..., 2].ravel() < 0,
        contacts=contacts,
    )
    visualizers = [item for item in graph.components if item.name == "surface_visualizer"]
    found = []
    for item, (turn, origin) in zip(visualizers, mounts(graph), strict=True):
        look = look_of(item)
        drawn = [*surface_markers(surface, look), *force_markers(field, look)]
        found.append([moved(marker, turn, origin) for marker in drawn])
    return found


def _touch(x, y, state=SlipState.STICK, force=-4.0):
    centre = np.array([x, y, 0.0])
    pushed = np.array([0.5, 0.0, force])
    outline = centre + 2e-3 * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    return made_contact(
        [0, 1, 2],
        slip=SlipEstimate(state),
        wrench=np.concatenate([pushed, np.cross(centre, pushed)]),
        covariance=np.diag([4e-4, 4e-4, 9e-4, 0, 0, 0]),
        area=1.25e-5,
        centre_of_pressure=centre,
        outline=outline,
    )


def _views(name):
    """Each saved view with its picture's size and the sensors that it is to show."""
    settings = read_settings(name)
    width, height = picture_px(settings)
    views = settings["Visualization Manager"]["Views"]
    found = [(View.of(views["Current"], height), slice(None))]
    origins = [origin for _, origin in mounts(load_graph("gripper"))]
    for number, view in enumerate(views["Saved"]):
        found.append((View.of(view, height, origins[number]), slice(number, number + 1)))
    return np.array([width, height]), found


def _texts(markers, namespace):
    return [marker for marker in markers if marker.text and marker.namespace == namespace]


def _in_order(markers):
    """The lines that belong together, from the top to the bottom as they are to be read."""
    contact, legend = _texts(markers, "contact_text"), _texts(markers, "legend")
    zero, deep, *scales = legend
    numbers = sorted({marker.number // 3 for marker in contact})
    of_contacts = [[m for m in contact if m.number // 3 == number] for number in numbers]
    return [*of_contacts, [deep, zero], scales]


def _bar_ends(markers, view):
    """Heights on the screen of the palest and the darkest end of the colour bar, px."""
    (bar,) = (m for m in markers if m.namespace == "legend" and len(m.points))
    heights = view.project(bar.points)[0][:, 1]
    brightness = bar.colours[:, :3].sum(axis=1)
    return heights[brightness.argmax()], heights[brightness.argmin()]


@pytest.mark.parametrize(
    "contacts",
    [
        [_touch(0.0, 0.0)],
        [_touch(-5e-3, 4e-3), _touch(5e-3, -4e-3, SlipState.FULL)],
        [_touch(x, y) for x, y in ((-1e-3, 3e-3), (1e-3, 3e-3), (0.0, -3e-3))],
    ],
    ids=["one contact", "two contacts", "three close together"],
)
def test_texts_can_be_read_in_each_view(name, contacts):
    """Lines high enough, in order, none on another, the bar large at its top, for each finger.

    ros2/rviz/1336, ros-visualization/rviz/345: RViz puts 5 mm between the lines of one text: here
    each line is a text, and no line has a break.  ros2/rviz/1261: a space is half of scale.x wide.
    """
    sensors = _shown(name, *contacts)
    _, views = _views(name)
    for view, chosen in views:
        boxes = []
        for markers in sensors[chosen]:
            for lines in _in_order(markers):
                own = [text_box(line, view) for line in lines]
                boxes += own
                bottoms = [low[1] for low, _ in own]
                assert bottoms == sorted(bottoms, reverse=True), [line.text for line in lines]
                assert min(high[1] - low[1] for low, high in own) >= LEAST_TEXT_PX
            assert not any("\n" in marker.text for marker in markers)
            large, small = _bar_ends(markers, view)
            assert large > small + 100
        for one, other in combinations(boxes, 2):
            assert (one[1] <= other[0]).any() or (other[1] <= one[0]).any()


def test_gels_are_large_and_whole_in_each_view(name):
    """With all texts of one contact, beside one another, and from 30 degrees off their planes."""
    least = LEAST_SHARES[name]
    sensors = _shown(name, _touch(0.0, 0.0))
    size, views = _views(name)
    for view, chosen in views:
        gels = []
        for markers in sensors[chosen]:
            (mesh,) = (m for m in markers if m.namespace == "surface")
            places = view.project(mesh.points)[0]
            gels.append((places.min(axis=0), places.max(axis=0)))
            faces = np.diff(mesh.points.reshape(-1, 3, 3), axis=1)
            normal = np.cross(faces[:, 0], faces[:, 1]).mean(axis=0)
            look = view.camera - mesh.points.mean(axis=0)
            facing = abs(look @ normal) / np.linalg.norm(look) / np.linalg.norm(normal)
            assert facing > np.sin(np.radians(30))
            corners = [corner for m in markers if m.text for corner in text_box(m, view)]
            assert (np.abs([*corners, *gels[-1]]) < size / 2).all()
        share = min(np.prod(high - low) for low, high in gels) / np.prod(size)
        assert share > least[len(gels)]
        for one, other in combinations(gels, 2):
            assert (one[1] <= other[0]).any() or (other[1] <= one[0]).any()


def test_each_kind_of_marker_can_be_switched_on_and_off(name, settings):
    """The list of namespaces is there before the first message comes."""
    drawn, *_ = _shown(name, _touch(0.0, 0.0))
    for kind, display in _displays(settings["Visualization Manager"]):
        if kind == "MarkerArray":
            expected = {marker.namespace: True for marker in drawn}
            assert display["Namespaces"] == expected
