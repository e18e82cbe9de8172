"""True grids go in over DDS; surfaces, displacement and reference are compared with the truth."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from cmp_tactile_msgs.msg import Grid as GridMsg
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import Grid, Status
from cmp_tactile_processing.nodes.stereo_triangulator import StampPairing, StereoTriangulator
from cmp_tactile_processing.ros.messages import conversions
from cmp_tactile_processing.ros.messages.conversions import grid_to_msg
from cmp_tactile_processing.ros.messages.reading import stamp_ns, surface_from_msg
from cmp_tactile_processing.sensor.description import load_sensor

pytestmark = pytest.mark.ros

SENSOR = load_sensor("sample_rig")
SHAPE = SENSOR.pattern.shape
# float32 carries 500 px to 3e-5 px, which is below 2 nm times the rig's 60 um per px.
ATOL_M = 1e-8


def _true_grid(sample, view: str, seen: np.ndarray | None = None) -> Grid:
    """The grid that a perfect tracker would give; corners that are not seen are missing."""
    placement = build_views(SENSOR)[view].placement
    q = placement.from_frame(sample.truth[f"corners_{view}_px"])
    status = np.ones(SHAPE.corners, np.uint8) if seen is None else seen.astype(np.uint8)
    q[status == Status.MISSING] = np.nan
    return replace(Grid.missing(SHAPE, ""), corners=q, corner_status=status)


def _grid_msg(sample, view: str, number: int, seen: np.ndarray | None = None) -> GridMsg:
    header = Header(stamp=Time(sec=number), frame_id=f"sample_rig_{view}_optical_frame")
    return grid_to_msg(_true_grid(sample, view, seen), header)


class Rig:
    """A triangulator with publishers of both grids and what it publishes."""

    def __init__(self, ros, **parameters) -> None:
        self.ros = ros
        self.node = ros.start(StereoTriangulator, **parameters)
        self.surfaces = ros.listen(SurfaceMsg, "surface")
        self._publishers = {
            view: ros.publisher(GridMsg, f"{view}/grid") for view in ("left", "right")
        }

    def send(self, sample, *numbers: int, seen: np.ndarray | None = None, views=("left", "right")):
        for number in numbers:
            for view in views:
                self.publish(view, _grid_msg(sample, view, number, seen))

    def send_shifted(self, sample, number: int, shift_px: float) -> None:
        """The left grid is lower by a shift, which is across the plane of the two rays."""
        right = _grid_msg(sample, "right", number)
        grid = _true_grid(sample, "left")
        grid = replace(grid, corners=grid.corners + [0.0, shift_px])
        self.publish("left", grid_to_msg(grid, right.header))
        self.publish("right", right)

    def publish(self, view: str, msg: GridMsg) -> None:
        self._publishers[view].publish(msg)

    def wait_surfaces(self, count: int) -> list:
        self.ros.wait(lambda: len(self.surfaces) >= count, f"{count} surfaces")
        return [surface_from_msg(msg, SHAPE) for msg in self.surfaces]

    def ask_for_reference(self):
        name = f"{self.ros.namespace}/stereo_triangulator/set_reference"
        return self.ros.call_later(Trigger, name, Trigger.Request())

    def set_reference_later(self):
        """Asked for, and the next frames count."""
        future = self.ask_for_reference()
        self.ros.wait(lambda: self.node._averaging.is_open, "the request")
        return future


def test_rays_that_miss_each_other_are_warned_of(ros, sample, capfd):
    """Nothing else shows that the sensor description is another sensor's."""
    rig = Rig(ros)
    rig.send(sample("rest"), 1)
    rig.wait_surfaces(1)
    assert "rays of a marker" not in "".join(capfd.readouterr())
    for number in (2, 3):
        rig.send_shifted(sample("rest"), number, 3.0)
    rig.wait_surfaces(3)
    log = "".join(capfd.readouterr())
    assert log.count("is sample_rig the description of this sensor?") == 1
    found = float(re.search(r"rays of a marker are (\d+) um apart, expected at most 50 um", log)[1])
    # 60 um per px on the gel, seen at a slant.
    assert 0.5 * 3 * 60 < found < 3 * 60


def test_a_grid_of_the_last_pass_meets_none_of_the_next(ros, sample):
    """A bag in a loop has the same stamps again: a grid that lost its partner waited for them."""
    rig = Rig(ros)
    rig.send(sample("rest"), 1)
    rig.send(sample("press"), 2, views=("left",))
    rig.send(sample("rest"), 3)
    rig.wait_surfaces(2)
    rig.send(sample("rest"), 1)
    rig.wait_surfaces(3)
    rig.send(sample("rest"), 2, views=("right",))
    ros.wait(lambda: rig.node.diagnostics.frames_in == 8, "the grid of the right view")
    rig.send(sample("rest"), 2, views=("left",))
    surface = rig.wait_surfaces(4)[3]
    rest = sample("rest").truth["corners_m"]
    np.testing.assert_allclose(surface.position, rest, atol=ATOL_M)
    assert (surface.status == Status.MEASURED).all()
    assert rig.node.diagnostics.started_again == 2, "on each of both topics"


def test_points_are_published_for_subscribers_only(ros, sample, count_calls):
    made = count_calls(conversions, "organised_cloud")
    rig = Rig(ros)
    rig.send(sample("press"), 1)
    rig.wait_surfaces(1)
    assert not made
    clouds = ros.listen(PointCloud2, "surface_points")
    ros.wait_subscribed(rig.node, "surface_points")
    rig.send(sample("press"), 2)
    ros.wait(lambda: clouds, "the cloud")
    (cloud,) = clouds
    assert cloud.header == rig.surfaces[1].header
    assert (cloud.height, cloud.width) == SHAPE.corners
    values = np.frombuffer(cloud.data, np.float32).reshape(20, 20, 6)
    np.testing.assert_array_equal(values[..., :3].ravel(), rig.surfaces[1].position)
    np.testing.assert_array_equal(values[..., 3:].ravel(), rig.surfaces[1].displacement)


def test_set_reference_averages_the_next_frames_and_answers(ros, sample):
    rig = Rig(ros, reference_frames=3)
    references = ros.listen(SurfaceMsg, "reference", latched=True)
    ros.wait(lambda: references, "the nominal reference")
    assert references[0].reference_id == 0
    press = sample("press")
    answer = rig.set_reference_later()
    rig.send(press, 1, 2)
    rig.wait_surfaces(2)
    assert not answer.done(), "two of three frames are not enough"
    rig.send(press, 3)
    ros.wait(answer.done, "the answer")
    assert answer.result().success
    assert re.fullmatch(
        r"reference 1 is the mean of 3 frames; but markers around \(\d+, \d+\) are \d+ um off the "
        r"shape at rest, expected at most 40 um: something touches the gel, or .*",
        answer.result().message,
    )
    rig.send(sample("slide"), 4)
    before, *_, at_reference, after = rig.wait_surfaces(4)
    assert before.reference_id == 0
    assert (after.reference_id, after.reference_stamp_ns) == (1, 3_000_000_000)
    np.testing.assert_allclose(at_reference.displacement, 0, atol=ATOL_M)
    moved = sample("slide").truth["corners_m"] - press.truth["corners_m"]
    np.testing.assert_allclose(after.displacement, moved, atol=ATOL_M)
    ros.wait(lambda: len(references) == 2, "the new reference")
    latched = surface_from_msg(references[1], SHAPE)
    np.testing.assert_allclose(latched.reference, press.truth["corners_m"], atol=ATOL_M)
    assert stamp_ns(references[1].header.stamp) == 3_000_000_000
    late = ros.listen(SurfaceMsg, "reference", latched=True)
    ros.wait(lambda: late, "the reference for a late subscriber")
    assert late[0].reference_id == 1
    assert late[0].reference == references[1].reference


def test_set_reference_without_frames_gives_up_and_can_be_asked_again(ros, sample):
    rig = Rig(ros, reference_frames=2, reference_timeout=0.2)
    first = rig.ask_for_reference()
    ros.wait(first.done, "the answer")
    assert not first.result().success
    topics = f"{ros.namespace}/left/grid and {ros.namespace}/right/grid"
    assert first.result().message == f"found 0 frames on {topics} in 0.2 s, expected 2"
    rig.node.set_parameters([Parameter("reference_timeout", value=20.0)])
    again = rig.set_reference_later()
    busy = rig.ask_for_reference()
    ros.wait(busy.done, "the answer while busy")
    assert not busy.result().success
    assert "already being taken" in busy.result().message
    rig.send(sample("rest"), 2, 3)
    ros.wait(again.done, "the second answer")
    assert again.result().success


def test_automatic_reference_waits_for_the_contact_to_end_and_says_so(ros, sample):
    reports = ros.reports("stereo_triangulator")
    rig = Rig(ros, rest_frames=4)
    rig.send(sample("press"), *range(1, 5))
    rig.wait_surfaces(4)
    ros.wait(lambda: "something touches the gel" in reports.last.message, "the report")
    assert reports.last.level == DiagnosticStatus.WARN
    assert "no reference yet" in reports.last.message
    values = reports.values
    assert (values["waiting for a reference"], values["tracked fraction"]) == ("True", "1.0000")
    rig.send(sample("rest"), *range(5, 9))
    assert rig.wait_surfaces(8)[-1].reference_id == 1
    ros.wait(lambda: "no reference yet" not in reports.last.message, "the next report")
    assert reports.values["reference frames"] == "4"


def test_drift_at_rest_is_warned_of(ros, sample):
    reports = ros.reports("stereo_triangulator")
    rig = Rig(ros, rest_frames=4, drift_time=0.0)
    rig.send(sample("rest"), *range(1, 5))
    for number in range(5, 9):
        for view in ("left", "right"):
            msg = _grid_msg(sample("rest"), view, number)
            moved = sample("rest").truth["corners_m"] + [20e-6, 0, 0]
            corners = build_views(SENSOR)[view].project(moved)
            grid = replace(_true_grid(sample("rest"), view), corners=corners)
            rig.publish(view, grid_to_msg(grid, msg.header))
    rig.wait_surfaces(8)
    ros.wait(lambda: "drifted" in reports.last.message, "the report")
    assert reports.last.level == DiagnosticStatus.WARN
    assert "drifted by 20 um since the reference" in reports.last.message
    assert "zero again" in reports.last.message
    values = {key: float(value) for key, value in reports.values.items() if "drift" in key}
    assert values == {
        "drift (um)": 20.0,
        "drift shift (um)": 20.0,
        "drift turn (mrad)": 0.0,
        "drift shape (um)": 0.0,
    }


@pytest.fixture
def pairing() -> StampPairing:
    return StampPairing(("left", "right"), capacity=4)


def test_the_oldest_is_given_up_when_a_side_stays_away(pairing):
    for stamp in range(100):
        assert pairing.add("left", stamp, stamp) is None
    assert pairing.unpaired == {"left": 96, "right": 0}
    assert pairing.add("right", 95, "r") is None
    assert pairing.add("right", 96, "r") == (96, "r")


def test_repeated_stamp_keeps_the_newer(pairing):
    pairing.add("left", 1, "old")
    pairing.add("left", 1, "new")
    assert pairing.unpaired["left"] == 1
    assert pairing.add("right", 1, "r") == ("new", "r")


def test_shuffled_within_the_buffer_loses_nothing():
    pairing = StampPairing(("left", "right"), capacity=10)
    rng = np.random.default_rng(5)
    arrivals = [
        (stamp + rng.uniform(0, 4), side, stamp)
        for stamp in range(200)
        for side in ("left", "right")
    ]
    pairs = [pairing.add(side, stamp, stamp) for _, side, stamp in sorted(arrivals)]
    assert sorted(pair for pair in pairs if pair) == [(stamp, stamp) for stamp in range(200)]
    assert pairing.unpaired == {"left": 0, "right": 0}
