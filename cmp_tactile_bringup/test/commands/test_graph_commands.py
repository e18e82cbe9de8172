"""The subcommands that start a graph pass on what they are given, wherever it stands."""

import io
import math
import re
from pathlib import Path
from typing import Any

import pytest
from command_output import run
from documents import assert_printed, shown_after

pytest.importorskip("rclpy")

from cmp_tactile_bringup.container import executables
from cmp_tactile_bringup.graphs.packaged import load_graph
from cmp_tactile_bringup.graphs.running import RunningLine, line_of
from cmp_tactile_msgs.msg import Contact, ForceField

FIRST_LOOK = Path(__file__).resolve().parents[3] / "docs" / "tutorials" / "first_look.md"


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """What `standalone` was called with, in the place of a container."""
    calls: list[list[str]] = []

    def record(args: Any, **_options: bool) -> int:
        calls.append(list(args))
        return 0

    monkeypatch.setattr(executables, "standalone", record)
    return calls


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("gripper left_name:=thumb", "gripper left_name:=thumb"),
        ("sensor device:=a --show-args sensor:=x", "sensor device:=a sensor:=x --show-args"),
    ],
)
def test_arguments_of_a_graph_reach_it(started, words, expected):
    assert run(*words.split()) == 0
    assert started == [expected.split()]


def test_arguments_follow_those_of_the_command(started, grasp_bag):
    assert run("live", "slip", "record:=there", "name:=finger") == 0
    assert run("replay", grasp_bag, "rate:=2.0", "record:=there") == 0
    (live, replay) = started
    assert live[0] == "simulate"
    assert {"scene:=slip", "record:=there", "name:=finger", "--watch"} <= set(live)
    assert {f"input:={grasp_bag}", "rate:=2.0", "record:=there"} <= set(replay)


def test_several_recordings_and_a_part_of_them_are_replayed(started, grasp_bag, tmp_path):
    (tmp_path / "0.png").write_bytes(b"opened only when it is read")
    both = [str(grasp_bag), str(tmp_path)]
    assert run("replay", *both, "name:=f") == 0
    expected = {f"input:={':'.join(both)}", "name:=f"}
    assert expected | {f"sensor:={grasp_bag}/sensor.yaml"} <= set(started[0])
    at_noon = tmp_path / "run 12:00"
    at_noon.symlink_to(grasp_bag)
    assert run("replay", at_noon, grasp_bag) == 0
    assert f"input:={at_noon}:{grasp_bag}" in started[1]
    # Cannot be distinguished from two recordings.
    (tmp_path / "run 12").touch()
    assert run("replay", at_noon) == 1
    assert run("replay", "name:=f") == 2


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("gripper left_name=thumb", "found 'left_name=thumb', expected NAME:=VALUE"),
        ("gripper left_name:=thumb --x", "no such option: --x"),
        ("live slip more", "found 'more' after the scene, expected NAME:=VALUE"),
        ("info --x a:=1", "no such option: --x"),
    ],
)
def test_anything_else_is_a_wrong_option(started, words, expected, capsys):
    assert run(*words.split()) == 2
    assert capsys.readouterr().err.startswith(f"error: {expected}")
    assert started == []


@pytest.mark.usefixtures("own_signals")
def test_arguments_are_listed_with_their_choices(capsys):
    for words in (["gripper"], ["sensor"], ["live"], ["replay"], ["replay", "grasp"]):
        assert run(*words, "--show-args") == 0
        text = capsys.readouterr().out
        assert "record_compression:= (one of zstd, png, jpeg, none)\n    compression of " in text
        assert "params_file:=\n    ROS parameter file" in text


def field(fz: float, **values: Any) -> ForceField:
    message = ForceField(**values)
    message.wrench.force.z = fz
    message.wrench_covariance[14] = 0.02**2
    return message


def test_the_running_line_shows_force_error_contacts_and_slip():
    assert line_of(field(0.0)) == " 0.000  0.000  0.000 N, +- 0.000 0.000 0.020   0 contacts"
    held = field(-5.17, contacts=[Contact(), Contact()], slip_state=ForceField.SLIP_INCIPIENT)
    (shown,) = shown_after(FIRST_LOOK, "cmp_tactile live grasp")
    one = field(-1.5, contacts=[Contact()], slip_state=ForceField.SLIP_STICK)
    # The words are those of the tutorial; the numbers are of another frame.
    assert_printed([shown], f"20.0 Hz   {line_of(one)}", absolute=10)
    assert line_of(held).endswith("-5.170 N, +- 0.000 0.000 0.020   2 contacts, begins to slip")
    unknown = field(math.nan, flags=ForceField.FLAG_FEW_MARKERS)
    assert line_of(unknown) == "force unknown   [few_markers]"


class Terminal(io.StringIO):
    """Takes lines that are written again in their place."""

    def isatty(self) -> bool:
        return True


def test_a_line_too_long_for_the_terminal_does_without_the_deviations(ros, monkeypatch):
    """What is seen of 80 columns must say that the contact slips, and which flags are set."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "xterm")
    graph = load_graph("simulate", {"sensor": "sample_rig", "namespace": "watched"})
    flags = ForceField.FLAG_AT_BORDER
    slips = field(-1.5, contacts=[Contact()], slip_state=ForceField.SLIP_INCIPIENT, flags=flags)
    out = Terminal()
    with RunningLine(graph, out):
        ros.publisher(ForceField, "/watched/force_field").publish(slips)
        ros.wait(lambda: "Hz" in out.getvalue(), "the line")
    line = out.getvalue().splitlines()[-1].partition("\x1b")[0]
    assert line.endswith("-1.500 N   1 contact, begins to slip   [at_border]")
    assert len(line) < 80


def test_the_running_line_begins_with_what_to_do_next(ros, tmp_path, monkeypatch):
    """In a pipe, a line at once; then every few seconds.  Its examples are found anywhere."""
    monkeypatch.chdir(tmp_path)
    graph = load_graph("simulate", {"sensor": "sample_rig", "namespace": "watched"})
    out = io.StringIO()
    with RunningLine(graph, out):
        publisher = ros.publisher(ForceField, "/watched/force_field")
        publisher.publish(field(-1.0))
        ros.wait(lambda: "Hz" in out.getvalue(), "the line")
    printed = out.getvalue().splitlines()
    example = re.search(r"python3 (\S+move_indenter.py) watched", printed[1])
    assert example
    assert Path(example[1]).is_file()
    assert "-1.000 N" in printed[-1]
    assert "\r" not in out.getvalue()
