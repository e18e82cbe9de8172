"""The gripper of the tutorial: its controller, its cup, and both on the simulated sensor."""

import csv
import importlib.util
import math
import signal
import subprocess
import sys
from collections import deque
from dataclasses import replace
from pathlib import Path

import pytest
from documents import assert_printed, shown_after

pytest.importorskip("rclpy")
from std_msgs.msg import Float64, String

from cmp_tactile_msgs.msg import ForceField, GraspState
from cmp_tactile_simulation.scenes.file import load_scene, write_scene

pytestmark = pytest.mark.ros

EXAMPLES = Path(__file__).resolve().parent.parent / "docs" / "examples"
TUTORIAL = EXAMPLES.parent / "tutorials" / "gripper.md"
PERIOD_S = 0.05
FRICTION = 0.4
# Settings for a busy computer: each stage that waits for a processor adds to the delay.
SLOW = {"timeout": 10.0, "response_time": 0.7, "approach_speed": 0.001}


def load(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


hold_force, cup_example = load("hold_force"), load("cup")
# In the stiffest grip that is tried here a delay of 1 s is undone by 0.3 a second: so much force is
# left to be undone where the gripper counts as still.
STILL_M = cup_example.STILL_M
STILL_N = STILL_M * 3000 / 0.3
Cup, Felt, Grip, Settings = cup_example.Cup, hold_force.Felt, hold_force.Grip, hold_force.Settings


def felt_of(cup):
    """What an exact sensor shows of the cup; the rim slides from half of the friction on."""
    if cup.normal <= 0.02:
        return Felt(0.0)
    used = cup.tangential / cup.normal / FRICTION
    if used > 0.94:
        return Felt(cup.normal, used * FRICTION, FRICTION, ForceField.SLIP_FULL)
    if used > 0.5:
        return Felt(cup.normal, used * FRICTION, math.nan, ForceField.SLIP_INCIPIENT)
    return Felt(cup.normal, used * FRICTION, math.nan, ForceField.SLIP_STICK)


def hold(cup, settings, delay):
    """Hold the cup to the end; time and normal force of each step."""
    grip = Grip(settings, cup.opening)
    on_the_way = deque([Felt(0.0)] * round(delay / PERIOD_S))
    while not (cup.held or cup.lost) and cup.time < 60:
        on_the_way.append(felt_of(cup))
        whole = delay + PERIOD_S + settings.response_time
        grip.update(on_the_way.popleft(), cup.opening, PERIOD_S, whole)
        cup.advance(grip.opening, PERIOD_S)
        yield cup.time, cup.normal


@pytest.mark.parametrize("delay", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("stiffness", [300, 800, 1500, 3000])
def test_a_cup_is_held_by_every_stiffness_and_delay_that_the_settings_allow(stiffness, delay):
    """Without swinging: what the approach may make too much sinks to the target and stays."""
    cup, settings = Cup(FRICTION, stiffness=stiffness, pour=6.0), Settings()
    run = list(hold(cup, settings, delay))
    assert cup.held
    assert cup.slid < 1e-3
    before = [normal for time, normal in run if time < cup.begin]
    assert before[-1] == pytest.approx(settings.target_force, abs=STILL_N)
    # The tutorial's bound of the first touch: the approach goes on for a delay.
    whole = delay + PERIOD_S + settings.response_time
    assert max(before) < settings.target_force + settings.approach_speed * stiffness * whole
    rest = before[before.index(max(before)) :]
    assert min(rest) > 0.9 * settings.target_force
    assert max(normal for _, normal in run) < 1.1 * settings.max_force


@pytest.mark.parametrize("stiffness", [300, 3000])
def test_the_same_cup_is_lost_without_the_reaction_to_slip(stiffness):
    cup = Cup(FRICTION, stiffness=stiffness, pour=6.0)
    list(hold(cup, replace(Settings(), boost=1.0), 0.05))
    assert cup.lost
    assert 0 < cup.acted < cup.pour


def gripped(settings=None, normal=2.0):
    """A grip of 1000 N/m that has touched at 40 mm."""
    grip = Grip(settings or Settings(), 0.040)
    grip.update(Felt(0.01), 0.040, 0.05, 0.2)
    for _ in range(100):
        grip.update(Felt(normal), 0.040 - normal / 1000, 0.05, 0.2)
    return grip


@pytest.mark.parametrize(
    "felt",
    [Felt(math.nan), Felt(math.inf), Felt(-math.inf)]
    + [Felt(1.0, flags=flag) for flag in (1, 4, 128, 129)],
)
def test_a_force_that_cannot_be_used_moves_nothing(felt):
    grip = gripped()
    before = grip.opening, grip.target
    assert grip.update(felt, 0.038, 0.05, 0.2).startswith("still: the force is not usable")
    assert (grip.opening, grip.target) == before


def test_too_large_a_force_opens_and_no_slip_asks_for_more_than_the_bound():
    settings = Settings()
    grip = gripped()
    for _ in range(50):
        slip = Felt(settings.max_force, 0.3, 0.3, ForceField.SLIP_FULL)
        grip.update(slip, grip.opening, 0.05, 0.2)
    assert grip.target == settings.max_force
    before = grip.opening
    state = grip.update(Felt(1.2 * settings.max_force), before, 0.05, 0.2)
    assert state.startswith("opening")
    assert grip.opening > before


def test_a_gripper_that_is_blocked_is_not_left_far_behind():
    settings = Settings()
    grip = Grip(settings, 0.040)
    for _ in range(1000):
        grip.update(Felt(0.0), 0.040, 0.05, 0.2)
    assert grip.opening == pytest.approx(0.040 - settings.max_lead)


class Running:
    """Processes of the test, with their output in files."""

    def __init__(self, folder):
        self.folder, self._all = folder, []

    def start(self, name, *command):
        with (self.folder / f"{name}.log").open("w") as log:
            started = subprocess.Popen(
                [sys.executable, *map(str, command)], stdout=log, stderr=subprocess.STDOUT
            )
        self._all.append(started)
        return started

    def logs(self):
        return "\n".join(path.read_text() for path in sorted(self.folder.glob("*.log")))

    def close(self):
        for process in self._all:
            process.kill()
            process.wait()


@pytest.fixture
def running(tmp_path):
    processes = Running(tmp_path)
    yield processes
    processes.close()


def test_the_grip_of_the_tutorial_holds_a_cup_that_is_filled(ros, running, tmp_path):
    """On the simulated sensor on a coarse mesh, with times that a busy computer keeps."""
    coarse = replace(load_scene("ball:16mm"), contact_nodes=20, samples=2)
    write_scene(coarse, tmp_path)
    scene = tmp_path / "scene.yaml"
    settings = {"sensor": "prototype", **SLOW}
    forces = ros.listen(ForceField, "/prototype/force_field")
    live = running.start(
        "live", "-m", "cmp_tactile_bringup.command", "live", scene, "autoplay:=false",
        "frame_rate:=5", f"params_file:={EXAMPLES / 'grip.yaml'}",
    )  # fmt: skip
    # Where nothing is compiled yet, that is done first.
    ros.wait(lambda: forces or live.poll() is not None, "the sensor", timeout_s=900)
    given = [item for key, value in settings.items() for item in ("-p", f"{key}:={value}")]
    controller = running.start("controller", EXAMPLES / "hold_force.py", "--ros-args", *given)
    table = tmp_path / "cup.csv"
    cup = running.start("cup", EXAMPLES / "cup.py", "--scene", scene, "--pour", 4, "--csv", table)
    commands = ros.listen(Float64, "/gripper/command")
    states = ros.listen(String, "/gripper/state")
    ros.wait(
        lambda: any(process.poll() is not None for process in (live, controller, cup)),
        "the cup to be filled",
        timeout_s=600,
    )
    assert live.poll() is None, running.logs()
    assert cup.wait(timeout=20) == 0, running.logs()

    live.send_signal(signal.SIGKILL)
    ros.wait(lambda: states and "no force" in states[-1].data, "the stop")
    count = len(commands)
    ros.wait(lambda: len(commands) >= count + 5, "commands that go on")
    assert len({message.data for message in commands[count:]}) == 1
    controller.send_signal(signal.SIGINT)
    assert controller.wait(timeout=20) == 0
    assert "Traceback" not in running.logs()
    shown = shown_after(TUTORIAL, "Then it prints a line every half second.")
    # Forces and times depend on the machine.
    printed = (tmp_path / "cup.log").read_text()
    assert_printed([shown[0], shown[1], shown[-1]], printed, absolute=1e9)
    check(table)


def check(table):
    with table.open() as file:
        rows = [
            {key: value if key == "state" else float(value) for key, value in row.items()}
            for row in csv.DictReader(file)
        ]
    target = Settings().target_force
    lift = next(number for number, row in enumerate(rows) if row["asked"] > 0)
    # What a gripper that counts as still may still have to undo: on a busy computer with the
    # longest delay that the controller takes. Meanwhile the force sinks by 0.03 N a second.
    delay = SLOW["timeout"] + SLOW["response_time"]
    left = STILL_M * Cup.stiffness / Settings().gain * delay
    assert target - 0.03 * delay < rows[lift]["true_normal"] < target + left
    assert rows[lift]["felt_normal"] == pytest.approx(rows[lift]["true_normal"], abs=0.2)
    # The first target would not have held the cup: the reaction to slip did.
    assert max(row["asked"] for row in rows) > 1.2 * FRICTION * target
    assert any(row["state"].startswith("gripping harder") for row in rows)
    assert rows[-1]["asked"] < FRICTION * rows[-1]["true_normal"]
    assert rows[-1]["slid"] < Cup.lost_after
    assert max(row["true_normal"] for row in rows) < 1.5 * Settings().max_force


def test_without_a_gripper_nothing_is_commanded(ros):
    ros.start(hold_force.HoldForce, sensor=ros.namespace.strip("/"))
    forces = ros.publisher(ForceField, "force_field")
    commands, states = ros.listen(Float64, "gripper/command"), ros.listen(String, "gripper/state")

    def said():
        message = ForceField()
        message.header.stamp = ros.node.get_clock().now().to_msg()
        forces.publish(message)
        ros.run(0.05)
        return any("no gripper/opening" in state.data for state in states)

    ros.wait(said, "what it waits for")
    assert commands == []


def test_of_two_fingers_the_weaker_force_is_held(ros):
    """None where one finger is missing."""
    ros.start(hold_force.HoldForce, grasp=f"{ros.namespace}/grasp_state")
    openings = ros.publisher(Float64, "gripper/opening")
    grasps = ros.publisher(GraspState, "grasp_state")
    states = ros.listen(String, "gripper/state")
    openings.publish(Float64(data=0.04))

    def says(text, **values):
        message = GraspState(**values)
        message.header.stamp = ros.node.get_clock().now().to_msg()
        grasps.publish(message)
        ros.run(0.05)
        return any(text in state.data for state in states)

    ros.wait(lambda: says("closing", normal_force=[3.0, 0.0]), "a finger without contact")
    slips = {"slip_state": ForceField.SLIP_FULL, "traction_ratio": 0.3}
    ros.wait(lambda: says("it slips", normal_force=[3.0, 2.0], **slips), "the slip")
    gone = {"normal_force": [math.nan] * 2, "flags": GraspState.FLAG_STALE}
    ros.wait(lambda: says(f"flags {GraspState.FLAG_STALE}", **gone), "the stop")


def test_settings_change_while_it_runs_but_not_to_nan(ros):
    from rclpy.parameter import Parameter

    node = ros.start(hold_force.HoldForce, sensor=ros.namespace.strip("/"))
    for value, taken in ((3.5, True), (math.nan, False), (-1.0, False), (1e9, False)):
        (changed,) = node.set_parameters([Parameter("target_force", value=value)])
        assert changed.successful == taken


@pytest.mark.parametrize("name", ["controller", "hold_force"])
def test_asking_for_help_starts_no_controller(name):
    """A gripper that closes would be a surprise."""
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert "-p sensor:=" in done.stdout
    assert done.stderr == ""
    assert name == "controller" or "  target_force: " in done.stdout
