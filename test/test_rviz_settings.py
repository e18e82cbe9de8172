"""The settings of RViz ask for topics that the nodes publish, and show what can be read.

RViz shows nothing of a topic that is not there, without a word.
"""

import re
from dataclasses import replace
from itertools import chain, combinations
from pathlib import Path

import numpy as np
import pytest
import yaml
from made_forces import made_contact, made_field

pytest.importorskip("rclpy")


from markers import look_of, mounts, moved
from rviz_view import View, picture_px, read_settings, text_box

from cmp_tactile_bringup.graphs.packaged import load_graph
from cmp_tactile_processing.force.grasp import GraspState
from cmp_tactile_processing.measured import SlipEstimate, SlipState
from cmp_tactile_processing.ros.messages.making import gel_frame
from cmp_tactile_processing.ros.rviz_markers import (
    force_markers,
    grasp_markers,
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
    "Marker": "visualization_msgs/Marker",
    "MarkerArray": "visualization_msgs/MarkerArray",
    "Wrench": "geometry_msgs/WrenchStamped",
    "PointCloud2": "sensor_msgs/PointCloud2",
    "Image": "sensor_msgs/Image",
}
LEAST_TEXT_PX = 12
# Of the picture that each gel covers where one or two are shown.
LEAST_SHARES = {"cmp_tactile.rviz": {1: 0.2}, "gripper.rviz": {1: 0.15, 2: 0.025}}
# Sizes of RViz's 3-D panel beside that of the packaged window, px.
PANELS_PX = (960, 720), (1280, 720)
GRASP = GraspState(
    grip_force=3.0,
    grip_axis=-np.eye(3)[1],
    load=-np.eye(6)[2],
    centre_of_contact=np.zeros(3),
)


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
        whole = display["Topic"]["Value"].removeprefix("/")
        first, _, rest = whole.partition("/")
        # What a gripper is and holds belongs to no sensor.
        namespace, topic = (first, rest) if rest and whole not in published else ("", whole)
        assert published[topic] == TYPES[kind]
        # Images are large: of a best-effort subscription most are lost.
        assert display["Topic"]["Reliability Policy"] == "Reliable"
        shown.setdefault(namespace, set()).add(topic)
    of_gripper = {"grasp_markers", "object/marker"}
    assert shown.pop("", set()) == (of_gripper if len(namespaces) == 2 else set())
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


def _views(settings):
    """Each view, with the sensors that it is to show."""
    views = settings["Visualization Manager"]["Views"]
    height = picture_px(settings)[1]
    yield View.of(views["Current"], height), slice(None)
    origins = [origin for _, origin in mounts(load_graph("gripper"))]
    for number, view in enumerate(views["Saved"]):
        yield View.of(view, height, origins[number]), slice(number, number + 1)


def _are_apart(boxes):
    return all(
        (one[1] <= other[0]).any() or (other[1] <= one[0]).any()
        for one, other in combinations(boxes, 2)
    )


def test_texts_can_be_read_in_each_view(name, settings):
    """High enough, and none on another.  RViz sets the lines of one text badly (ros2/rviz/1336)."""
    sensors = _shown(name, _touch(-5e-3, 4e-3), _touch(5e-3, -4e-3, SlipState.FULL))
    for view, chosen in _views(settings):
        texts = [marker for markers in sensors[chosen] for marker in markers if marker.text]
        boxes = [text_box(marker, view) for marker in texts]
        assert min(high[1] - low[1] for low, high in boxes) >= LEAST_TEXT_PX
        assert _are_apart(boxes)
        assert not any("\n" in marker.text for marker in texts)


def _extents(markers, view):
    """Lower left and upper right of the gel, and of each text and legend, px from the middle."""
    gel, *bars = (
        (place.min(axis=0), place.max(axis=0))
        for kind in ("surface", "legend")
        for place in (
            view.project(m.points)[0] for m in markers if m.namespace == kind and len(m.points)
        )
    )
    return gel, [*bars, *(text_box(m, view) for m in markers if m.text)]


@pytest.mark.parametrize("panel_px", PANELS_PX)
def test_the_line_of_a_grasp_stands_clear_of_the_fingers(panel_px):
    """Whole, high enough, and beside all that is written of the contacts."""
    settings = read_settings("gripper.rviz")
    view = View.of(settings["Visualization Manager"]["Views"]["Current"], panel_px[1])
    known = {"slip_margin": 0.4, "supported_weight": 1.5}
    line = grasp_markers(replace(GRASP, **known), 0.005)[-1]
    fingers = _shown("gripper.rviz", _touch(-5e-3, 4e-3), _touch(5e-3, -4e-3, SlipState.FULL))
    low, high = text_box(line, view)
    assert (np.abs([low, high]) < np.array(panel_px) / 2).all()
    assert high[1] - low[1] >= LEAST_TEXT_PX
    texts = [marker for markers in fingers for marker in markers if marker.text]
    assert _are_apart([(low, high), *(text_box(marker, view) for marker in texts)])


def test_gels_are_large_and_whole_in_each_view(name, settings):
    """With all texts of one contact in the picture."""
    sensors = _shown(name, _touch(0.0, 0.0))
    size = np.array(picture_px(settings))
    for view, chosen in _views(settings):
        gels, beside = zip(*(_extents(markers, view) for markers in sensors[chosen]), strict=True)
        assert (np.abs([*gels, *chain(*beside)]) < size / 2).all()
        assert _are_apart(gels)
        smallest = min(np.prod(high - low) for low, high in gels)
        assert smallest > LEAST_SHARES[name][len(gels)] * np.prod(size)


@pytest.mark.parametrize("panel_px", PANELS_PX)
def test_both_fingers_are_whole_and_alike_in_panels_of_other_shapes(panel_px):
    settings = read_settings("gripper.rviz")
    view = View.of(settings["Visualization Manager"]["Views"]["Current"], panel_px[1])
    shown = _shown("gripper.rviz", _touch(0.0, 0.0))
    gels, beside = zip(*(_extents(markers, view) for markers in shown), strict=True)
    assert (np.abs([*gels, *chain(*beside)]) < np.array(panel_px) / 2).all()
    left, right = (high - low for low, high in gels)
    assert left == pytest.approx(right, rel=0.01)
    for markers in shown:
        surface = next(m.points for m in markers if m.namespace == "surface")
        centre = surface.mean(axis=0)
        outwards = np.array([0.0, -np.sign(centre[1]), 0.0])
        assert (view.camera - centre) @ outwards > 0, "the sensing side faces the viewer"


def test_each_kind_of_marker_can_be_switched_on_and_off(name, settings):
    """The list of namespaces is there before the first message comes."""
    of_sensor, *_ = _shown(name, _touch(0.0, 0.0))
    for kind, display in _displays(settings["Visualization Manager"]):
        if kind == "MarkerArray":
            is_grasp = display["Topic"]["Value"] == "/grasp_markers"
            drawn = grasp_markers(GRASP, 0.005) if is_grasp else of_sensor
            expected = {marker.namespace: True for marker in drawn}
            assert display["Namespaces"] == expected
