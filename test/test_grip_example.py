"""The grip controller: on a cup without ROS, and on a live grasp as in the tutorial."""

import importlib.util
import math
import signal
import subprocess
import sys
from collections import deque
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import pytest
import yaml

pytest.importorskip("rclpy")
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Float64, String

from cmp_tactile_msgs.msg import ForceField, GraspState
from cmp_tactile_simulation.grasp.scene import packaged_grasps

pytestmark = pytest.mark.ros

EXAMPLES = Path(__file__).resolve().parent.parent / "docs" / "examples"
PERIOD_S = 0.05
FRICTION = 0.4
G = 9.81
STEP_S = 1e-3
FALLS_M = 0.01  # in a tenth of a second: nobody sets down a flask so quickly
STILL_M = 2e-5  # a gripper that moves less in a second stands still
# Settings for a busy computer: each stage that waits for a processor adds to the delay.
SLOW = {"timeout": 10.0, "response_time": 0.7, "approach_speed": 0.001}


def load(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


hold_force = load("hold_force")
# In the stiffest grip that is tried here a delay of 1 s is undone by 0.3 a second: so much force is
# left to be undone where the gripper counts as still.
STILL_N = STILL_M * 3000 / 0.3
Felt, Grip, Settings = hold_force.Felt, hold_force.Grip, hold_force.Settings


@dataclass
class Cup:
    """A cup between two fingers that press equally; forces are those on one finger, in SI units.

    friction: coefficient between finger and cup.  stiffness: force per distance closed, N/m, of
    finger, gel and cup together.  lag: time constant of the gripper, s.
    """

    friction: float
    stiffness: float = 1500.0
    lag: float = 0.08
    width: float = 0.060
    opening: float = 0.063
    empty: float = 0.04
    water: float = 0.20
    pour: float = 8.0  # time of filling, s
    knock: float = 1.3  # factor of the weight for 0.2 s, 2 s after the end of filling
    time: float = 0.0
    begin: float = math.inf  # time of lifting, after the gripper was still around it for a second
    acted: float = 0.0  # time since lifting
    slid: float = 0.0
    lost_after: float = 0.02
    _speed: float = field(default=0.0, repr=False)
    _stood: float = field(default=0.0, repr=False)
    _place: float = field(default=0.0, repr=False)

    @property
    def held(self):
        """Whether the cup was filled and knocked, and is still held."""
        return self.acted >= self.pour + 6.0 and not self.lost

    @property
    def lost(self):
        """Whether the cup slid out of the fingers."""
        return self.slid > self.lost_after

    @property
    def normal(self):
        """Normal force of each finger, N."""
        return 0.0 if self.lost else self.stiffness * max(0.0, self.width - self.opening)

    @property
    def asked(self):
        """Load that each finger must carry to hold the cup, N."""
        if math.isinf(self.begin):
            return 0.0  # the cup stands on the table
        mass = self.empty + self.water * min(1.0, self.acted / self.pour)
        knocked = 0 <= self.acted - (self.pour + 2.0) < 0.2
        return mass * G / 2 * (self.knock if knocked else 1.0)

    @property
    def tangential(self):
        """Load that each finger carries, N."""
        return min(self.asked, self.friction * self.normal)

    def advance(self, command, duration):
        """Advance the time by `duration` with this commanded opening."""
        for _ in range(round(duration / STEP_S)):
            self.time += STEP_S
            self.acted += 0.0 if math.isinf(self.begin) else STEP_S
            self.opening += (command - self.opening) * STEP_S / self.lag
            if abs(self.opening - self._place) > STILL_M or not self.normal:
                self._place, self._stood = self.opening, 0.0
            self._stood += STEP_S
            if self._stood > 1.0:
                self.begin = min(self.begin, self.time)
            mass = self.empty + self.water * min(1.0, self.acted / self.pour)
            pull = 2 * (self.asked - self.friction * self.normal) / mass
            self._speed = max(0.0, self._speed + pull * STEP_S)
            self.slid += self._speed * STEP_S


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


@pytest.mark.parametrize("boost", [1.25, 1.0])
def test_a_flask_that_is_filled_is_held_by_the_reaction_to_slip_alone(
    ros, running, tmp_path, boost
):
    """The live grasp of the tutorial, in simulated time, with settings for a busy computer."""
    scene = yaml.safe_load(packaged_grasps()["flask"].read_text(encoding="utf-8"))
    fill = next(phase for phase in scene["motion"] if phase["name"] == "fill")
    fill["duration"] = 5.0
    path = tmp_path / "flask.yaml"
    path.write_text(yaml.safe_dump(scene, sort_keys=False), encoding="utf-8")
    forces = ros.listen(ForceField, "/left_finger/force_field")
    poses, states = ros.listen(PoseStamped, "/object/pose"), ros.listen(String, "/gripper/state")
    commands = ros.listen(Float64, "/gripper/command")
    live = running.start(
        "live", "-m", "cmp_tactile_bringup.command", "grasp", path, "--live", "drive:=command",
        "loop:=false",
    )  # fmt: skip
    # Where nothing is compiled yet, that is done first.
    ros.wait(lambda: forces or live.poll() is not None, "the sensors", timeout_s=900)
    settings = {"sensor": "left_finger", "use_sim_time": "true", "target_force": 1.5, **SLOW}
    given = [item for key, value in settings.items() for item in ("-p", f"{key}:={value}")]
    given += ["-p", f"boost:={boost}"]
    controller = running.start("controller", EXAMPLES / "hold_force.py", "--ros-args", *given)

    def height():
        return poses[-1].pose.position.z if poses else 0.0

    ros.wait(lambda: height() > 0.045, "the flask to be lifted", timeout_s=300)
    ros.wait(lambda: height() < 0.025, "the flask to be set down, or lost", timeout_s=300)
    assert live.poll() is None, running.logs()
    assert controller.poll() is None, running.logs()
    reacted = any("gripping harder" in state.data for state in states)
    slips = [stamp(item) for item in forces if item.slip_state >= ForceField.SLIP_INCIPIENT]
    falls = [
        stamp(after)
        for before, after in pairwise(poses)
        if before.pose.position.z - after.pose.position.z > FALLS_M
    ]
    if boost > 1:
        assert reacted
        assert not falls, running.logs()
    else:
        # The slip is reported before the flask is lost.
        assert not reacted
        assert falls, running.logs()
        assert slips[0] < falls[0]
    live.send_signal(signal.SIGKILL)
    ros.wait(lambda: states and "no force" in states[-1].data, "the stop")
    count = len(commands)
    ros.wait(lambda: len(commands) >= count + 5, "commands that go on")
    assert len({message.data for message in commands[count:]}) == 1
    controller.send_signal(signal.SIGINT)
    assert controller.wait(timeout=20) == 0
    assert "Traceback" not in running.logs()


def stamp(message):
    """s."""
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


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
