"""The settings of RViz ask for topics that the nodes publish, and for properties that RViz has.

RViz passes over a key that it does not know and shows nothing of a topic that is not there, both
without a word.
"""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from command_output import output_of
from made_forces import made_field
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy")


from cmp_tactile_bringup.graphs.packaged import gripper
from cmp_tactile_processing.drawing.looks import DEPTH_PALETTE
from cmp_tactile_processing.measured import SlipState
from cmp_tactile_processing.ros.messages.making import gel_frame
from cmp_tactile_processing.ros.rviz.markers import (
    MarkerParameters,
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
# What a display's own class reads, in rviz_default_plugins of Kilted.
OWN_KEYS = {
    "Grid": "Alpha, Cell Size, Color, Line Style, Normal Cell Count, Offset, Plane, "
    "Plane Cell Count, Reference Frame",
    "TF": "Frame Timeout, Frames, Marker Scale, Show Arrows, Show Axes, Show Names, Tree, "
    "Update Interval",
    "MarkerArray": "Namespaces, Topic",
    "Wrench": "Accept NaN Values, Alpha, Arrow Width, Force Arrow Scale, Force Color, "
    "History Length, Topic, Torque Arrow Scale, Torque Color",
    "PointCloud2": "Alpha, Autocompute Intensity Bounds, Channel Name, Color Transformer, "
    "Decay Time, Invert Rainbow, Max Color, Max Intensity, Min Color, Min Intensity, "
    "Position Transformer, Selectable, Size (Pixels), Style, Topic, Use rainbow",
    "Image": "Max Value, Median window, Min Value, Normalize Range, Topic",
}
TYPES = {
    "MarkerArray": "visualization_msgs/MarkerArray",
    "Wrench": "geometry_msgs/WrenchStamped",
    "PointCloud2": "sensor_msgs/PointCloud2",
    "Image": "sensor_msgs/Image",
}
TOUCHING = (SlipState.STICK, SlipState.INCIPIENT, SlipState.FULL)
TOOLS = ("MoveCamera", "Select", "FocusCamera", "Measure")
PANELS = {"rviz_common/Displays", "rviz_common/Views"}
COMMON_KEYS = {"Class", "Enabled", "Name", "Value"}
TOPIC_KEYS = {"Depth", "Durability Policy", "History Policy", "Reliability Policy", "Value"}
VIEW_KEYS = (
    "Class, Distance, Enable Stereo Rendering, Focal Point, Focal Shape Fixed Size, "
    "Focal Shape Size, Invert Z Axis, Name, Near Clip Distance, Pitch, Target Frame, Value, Yaw"
)
# Displays whose messages wait for tf in a filter.
FILTERED = {"Wrench", "PointCloud2"}


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


def test_every_property_is_one_of_its_display(settings):
    manager = settings["Visualization Manager"]
    for kind, display in _displays(manager):
        assert set(display) == set(OWN_KEYS[kind].split(", ")) | COMMON_KEYS, display["Name"]
        if "Topic" in display:
            expected = TOPIC_KEYS | ({"Filter size"} if kind in FILTERED else set())
            assert set(display["Topic"]) == expected, display["Name"]
        if kind == "PointCloud2":
            # Of clouds with NaN, RViz computes bounds that are anything.
            assert display["Autocompute Intensity Bounds"] is False
            assert display["Min Intensity"] < display["Max Intensity"] == 0
            # From the mesh's colour of the deepest press to that of rest.
            assert display["Use rainbow"] is False
            for key, colour in (("Min Color", DEPTH_PALETTE[-1]), ("Max Color", DEPTH_PALETTE[0])):
                shown = [int(part) for part in display[key].split("; ")]
                # RViz's colours are of 8 bits.
                np.testing.assert_allclose(shown, 255 * colour[:3], atol=0.5)
        if kind not in ("MarkerArray", "Image"):
            assert display["Value"] == display["Enabled"]
    views = manager["Views"]
    for view in (views["Current"], *views["Saved"]):
        assert set(view) == set(VIEW_KEYS.split(", "))
    tools = {tool["Class"] for tool in manager["Tools"]}
    assert tools == {f"rviz_default_plugins/{tool}" for tool in TOOLS}
    assert {panel["Class"] for panel in settings["Panels"]} == PANELS
    assert set(manager["Global Options"]) == {"Background Color", "Fixed Frame", "Frame Rate"}


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


def test_frames_do_not_cover_the_gels(name, settings):
    """No names, axes of at most a hundredth of RViz's, and none at the optical frames."""
    (frames,) = (d for kind, d in _displays(settings["Visualization Manager"]) if kind == "TF")
    assert frames["Show Names"] is False
    assert frames["Marker Scale"] <= 0.01
    cameras = ("camera", "left", "right")
    hidden = {f"{sensor}_{c}_optical_frame" for sensor in FILES[name][1] for c in cameras}
    assert frames["Frames"] == {"All Enabled": True} | {name: {"Value": False} for name in hidden}


def _projected(view, centre, points):
    """Where points (N, 3) are in the picture of an orbit around `centre`, -1 to 1 at its borders.

    The camera of RViz sees 45 degrees of height.
    """
    camera, back, right, up = _camera(view, centre)
    seen = points - camera
    depth = -(seen @ back)
    flat = np.stack([seen @ right, seen @ up], axis=-1) / depth[:, None]
    return flat / np.tan(np.radians(45 / 2))


def _camera(view, centre):
    yaw, pitch = view["Yaw"], view["Pitch"]
    back = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    return centre + view["Distance"] * back, back, right, np.cross(back, right)


def test_both_gels_of_the_gripper_can_be_read():
    """From 30 degrees off their planes at least, whole and beside one another."""
    folder = ROOT / "cmp_tactile_bringup"
    text = (folder / "rviz" / "gripper.rviz").read_text(encoding="utf-8")
    views = yaml.safe_load(text)["Visualization Manager"]["Views"]
    corners = load_sensor("sample_rig").pattern.corners().reshape(-1, 3)
    gels = {}
    defaults = {item.name: item.default for item in gripper.own_arguments}
    for side in ("left", "right"):
        x, y, z, *angles = defaults[f"{side}_mount"]
        turn = Rotation.from_euler("xyz", angles).as_matrix()
        origin = np.array([x, y, z])
        gels[defaults[f"{side}_name"]] = origin + corners @ turn.T, turn[:, 2], origin
    framed = [(views["Current"], np.zeros(3), list(gels))]
    for view in views["Saved"]:
        name = view["Target Frame"].removesuffix("_gel_frame")
        # RViz's orbit follows the place of its frame, not how that is turned.
        framed.append((view, gels[name][2], [name]))
    assert len(framed) == 3
    for view, centre, names in framed:
        camera = _camera(view, centre)[0]
        boxes = []
        for name in names:
            points, normal, origin = gels[name]
            look = camera - origin
            assert abs(look @ normal) > np.sin(np.radians(30)) * np.linalg.norm(look)
            place = _projected(view, centre, points)
            # The picture is an eighth less wide than high.
            assert np.abs(place).max() < 0.85
            boxes.append((place.min(axis=0), place.max(axis=0)))
        if len(boxes) == 2:
            (low, high), (other_low, other_high) = boxes
            assert (low > other_high).any() or (other_low > high).any()


def test_each_kind_of_marker_can_be_switched_on_and_off(settings):
    """The list of namespaces is there before the first message comes."""
    sensor = load_sensor("sample_rig")
    surface = surface_at_rest(Reference.nominal(sensor), sensor.pattern.shape)
    look = MarkerParameters()
    drawn = [*surface_markers(surface, look), *force_markers(made_field(0, 0), look)]
    for kind, display in _displays(settings["Visualization Manager"]):
        if kind == "MarkerArray":
            expected = {marker.namespace: True for marker in drawn}
            assert display["Namespaces"] == expected


def test_images_have_their_place_in_the_window(settings):
    """Docks that the state of the window does not name pile up below the list of displays."""
    geometry = settings["Window Geometry"]
    # RViz reads these two without a default.
    assert (geometry["Hide Left Dock"], geometry["Hide Right Dock"]) == (False, False)
    state = bytes.fromhex(geometry["QMainWindow State"])
    images = [
        d["Name"] for kind, d in _displays(settings["Visualization Manager"]) if kind == "Image"
    ]
    panels = [panel["Name"] for panel in settings["Panels"]]
    for dock in [*images, *panels]:
        assert dock.encode("utf-16-be") in state
        assert geometry[dock] == {"collapsed": False}


@pytest.mark.usefixtures("short_scenes", "grasp_bag")
def test_the_drawing_of_the_markers_is_made(tmp_path):
    """Of the size of the one in the documentation, and as colourful."""
    picture = tmp_path / "markers.png"
    output_of(ROOT / "docs" / "drawings" / "markers.py", picture)
    kept = cv2.imread(str(ROOT / "docs" / "images" / "markers.png"))
    drawn = cv2.imread(str(picture))
    assert drawn.shape == kept.shape
    for image in (drawn, kept):
        blue, green, red = np.moveaxis(image.reshape(-1, 3).astype(int), -1, 0)
        deepest = (red > 140) & (green > 140) & (blue < 90)
        force = (red > 200) & (green < 100) & (blue < 80)
        contact = (green > 220) & (red < 100) & (blue < 100)
        displacement = (red > 240) & (green > 240) & (blue > 240)
        assert min(part.sum() for part in (deepest, force, contact, displacement)) > 500
