"""`cmp_tactile zero`, `call`, `topics` and `echo` beside nodes that run."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from typing import Any

import pytest
from ros_graph import stamps_of

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

import rclpy
import yaml
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool, Trigger

from cmp_tactile_bringup.commands import parse, running
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_driver.nodes.replay import Replay
from cmp_tactile_msgs.msg import Contact, ForceField
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.nodes.stereo_triangulator import StereoTriangulator
from cmp_tactile_processing.nodes.view_splitter import ViewSplitter
from cmp_tactile_processing.ros import process, services
from cmp_tactile_processing.ros.services import settled


@pytest.fixture
def run(ros):
    """Runs a subcommand beside the nodes; its exit code."""
    with ThreadPoolExecutor(1) as pool:

        def run_beside(*words: str, meanwhile: Any = None) -> int:
            running_one = pool.submit(parse(words).run)
            if meanwhile is not None:
                meanwhile()
            ros.wait(running_one.done, f"the end of {words}")
            return running_one.result()

        yield run_beside


@pytest.fixture
def asking(monkeypatch):
    """The node of all commands: what the first of them has found is there for the next."""
    with process.Listener("asking") as listener:
        monkeypatch.setattr(process, "Listener", lambda _name: nullcontext(listener))
        yield listener.node


class Zeroed:
    """Stands for the node that takes the reference."""

    def __init__(self, ros: Any, *, success: bool, message: str) -> None:
        self.count = 0
        self._answer = {"success": success, "message": message}
        ros.node.create_service(Trigger, "stereo_triangulator/set_reference", self._on_call)

    def _on_call(self, _request: Any, response: Any) -> Any:
        self.count += 1
        response.success, response.message = self._answer["success"], self._answer["message"]
        return response


def pressed(ros: Any, contacts: int, flags: int = 0) -> None:
    """Somebody presses with 5 N as long as the test runs."""
    field = ForceField(contacts=[Contact()] * contacts, flags=flags)
    field.wrench.force.x, field.wrench.force.z = 3.0, -4.0
    publisher = ros.node.create_publisher(ForceField, "force_field", 10)
    ros.node.create_timer(0.05, lambda: publisher.publish(field))


@pytest.mark.parametrize("name", ["", "{}", "{}/force_field"])
def test_the_sensor_that_runs_is_zeroed(ros, run, capsys, name):
    """By itself, by its namespace, or by one of its topics."""
    ros.start(ViewSplitter)
    zeroed = Zeroed(ros, success=True, message="reference 2 is the mean of 10 frames")
    pressed(ros, contacts=0)
    assert run("zero", *([name.format(ros.namespace)] if name else [])) == 0
    assert zeroed.count == 1
    out = capsys.readouterr().out
    assert out == f"{ros.namespace}: reference 2 is the mean of 10 frames\n"


def test_a_zero_under_load_is_refused_with_the_load(ros, run, capsys):
    ros.start(ViewSplitter)
    zeroed = Zeroed(ros, success=True, message="reference 2")
    pressed(ros, contacts=2)
    with pytest.raises(CmpTactileError, match=r"found a load of 5\.00 N \(2 contacts\).*--loaded"):
        run("zero")
    assert zeroed.count == 0
    assert run("zero", "--loaded") == 0
    assert zeroed.count == 1
    assert "reference 2" in capsys.readouterr().out


def test_a_sensor_without_frames_refuses(ros, run):
    """The node itself, and what it answers."""
    ros.start(ViewSplitter)
    ros.start(StereoTriangulator, reference_timeout=0.2)
    with pytest.raises(CmpTactileError, match=r"refused: found 0 frames .*left/grid .*expected 10"):
        run("zero")


def test_of_several_sensors_one_is_to_be_named(ros, run):
    ros.start(ViewSplitter)
    other = rclpy.create_node(
        "view_splitter", context=ros.context, namespace=f"{ros.namespace}/below"
    )
    zeroed = Zeroed(ros, success=True, message="")
    both = f"expected the namespace of one of: {ros.namespace}, {ros.namespace}/below"
    with pytest.raises(CmpTactileError, match=both):
        run("zero")
    assert run("zero", ros.namespace) == 0
    assert zeroed.count == 1
    other.destroy_node()


def test_no_sensor_and_one_of_another_name(ros, run, monkeypatch):
    monkeypatch.setattr(running, "SEARCH_TIME_S", 0.3)
    with pytest.raises(
        CmpTactileError, match="found no running sensor, expected one; is ROS_DOMAIN"
    ):
        run("zero")
    monkeypatch.setattr(running, "SEARCH_TIME_S", 8.0)
    ros.start(ViewSplitter)
    with pytest.raises(CmpTactileError, match=f"in /thumb, expected {ros.namespace}"):
        run("zero", "thumb")


@pytest.mark.usefixtures("asking")
def test_a_replay_is_stepped_moved_and_resumed(ros, run, grasp_bag, capsys):
    """Where it is asked to, by the stamps of the frames that come."""
    images = ros.listen(Image, "image_raw")
    # Begins again at the end: it is still playing when it is asked to step.
    ros.start(Replay, input=str(grasp_bag), paused=True, loop=True)
    stamps = [frame.stamp_ns for frame in BagReader(grasp_bag).frames()]

    step = f"{ros.namespace}/replay/step"
    assert run("call", step) == 0
    ros.wait(lambda: images, "the first frame")
    assert stamps_of(images) == stamps[:1]
    # A whole number where a real one is meant; a name by its end.
    assert run("call", "replay", "start:=0", "rate:=4") == 0
    assert run("call", "replay", "start:=0.4") == 0
    assert run("call", "replay/step") == 0
    ros.wait(lambda: len(images) > 1, "a frame at 0.4 s")
    assert stamps_of(images)[-1] - stamps[0] == pytest.approx(0.4e9, abs=0.04e9)
    assert run("call", "replay/pause", "data:=false") == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"{ros.namespace}/replay/pause: playing"
    with pytest.raises(CmpTactileError, match=r"refused: .*playing, expected paused"):
        run("call", "replay/step")


WRONG_CALLS = {
    "call replay/paus": "found no such service, expected one of .*/replay/pause, .*mean '/replay/",
    "call replay/pause data:=1": "data: found '1', expected boolean",
    "call replay/pause data": "found 'data', expected NAME:=VALUE",
    "call replay/pause dada:=true": r"field 'dada', expected data \(boolean\); did you mean 'data'",
    "call replay/step data:=true": "found no field 'data', expected no field",
    "call replay strt:=1": r"no parameter 'strt', expected one of .*loop, .*you mean 'start'",
    "call replay start:=-1": "refused: .*start",
    "call replay loop:=true": "refused: .*loop",
    "call replay": "found no parameter '', expected one of .*loop",
    "call nobody_answers": "nobody_answers: found no such service, expected one of",
    "echo force_feld": r"force_feld: found no such .*mean '/force_field'",
}


def test_a_wrong_name_or_value_is_one_line_with_what_there_is(
    ros, run, asking, grasp_bag, monkeypatch
):
    """Reports of the kind, tried here:
    RobotWebTools/rosbridge_suite 905 (a name that a client waits for is listed as a service, and a
    call of it hangs): `nobody_answers`, refused as not there.
    RobotWebTools/rosbridge_suite 461 (a bool is refused as no boolean): true is taken, 1 is refused
    as no boolean.
    """
    ros.start(Replay, input=str(grasp_bag), paused=True)
    ros.node.create_client(SetBool, "nobody_answers")
    ros.node.create_publisher(ForceField, "force_field", 10)
    for words in ("replay/pause data:=true", "replay/step", "replay rate:=1"):
        assert run("call", *words.split()) == 0
    ros.wait(lambda: asking.count_publishers(f"{ros.namespace}/force_field"), "the topic")
    # All is found: what is not there need not be looked for.
    monkeypatch.setattr(services, "settled", lambda ask, *_: settled(ask, 0.2, 0.1))
    for words, error in WRONG_CALLS.items():
        with pytest.raises(CmpTactileError, match=error) as refused:
            run(*words.split())
        assert "\n" not in str(refused.value)


@pytest.mark.usefixtures("asking")
def test_no_parameter_is_set_where_one_is_refused(ros, run, grasp_bag):
    """Reports: ros2/rclcpp 1952, ros2/ros2cli 721; tried: those before it were set."""
    replay = ros.start(Replay, input=str(grasp_bag), paused=True)
    with pytest.raises(CmpTactileError, match=r"refused: .*start"):
        run("call", "replay", "rate:=4", "start:=-1")
    assert replay.get_parameter("rate").value == 1.0


@pytest.mark.usefixtures("asking")
def test_a_name_that_several_have_is_asked_about_and_one_that_comes_late_is_found(ros, run):
    """Report of the kind, tried here: ros2/ros2cli 37 (a call before the service is there never
    comes through): it is waited for."""

    def answer(_request: Any, response: Any) -> Any:
        response.success = True
        return response

    def start() -> None:
        ros.run(0.3)
        ros.node.create_service(Trigger, "a/go", answer)

    assert run("call", "go", meanwhile=start) == 0
    ros.node.create_service(Trigger, "b/go", answer)
    with pytest.raises(CmpTactileError, match=f"several, .*: {ros.namespace}/a/go, .*/b/go"):
        run("call", "go")
    assert run("call", "b/go") == 0


def test_topics_are_listed_and_one_is_printed_as_it_comes(ros, run, capsys):
    """By the end of its name; the field that is long is cut, the publisher is best effort."""
    field = ForceField(position=[0.5] * 600, contacts=[Contact(area=2e-5)])
    field.wrench.force.z = -1.5
    publisher = ros.node.create_publisher(ForceField, "force_field", qos_profile_sensor_data)
    ros.node.create_timer(0.05, lambda: publisher.publish(field))
    assert run("topics") == 0
    listed = dict(line.split() for line in capsys.readouterr().out.splitlines())
    assert listed[f"{ros.namespace}/force_field"] == "cmp_tactile_msgs/msg/ForceField"
    assert run("echo", "force_field", "--once") == 0
    text, _, rest = capsys.readouterr().out.partition("---")
    shown = yaml.safe_load(text)
    assert rest == "\n"
    assert shown["wrench"]["force"]["z"] == -1.5
    assert shown["contacts"][0]["area"] == pytest.approx(2e-5)
    assert shown["position"][0] == 0.5
    assert len(shown["position"]) < 20
