"""docs/tutorials/calibrate.md: its commands do what it says."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from documents import assert_printed, shell_lines, shown_after

from cmp_tactile_bringup.command import main
from cmp_tactile_bringup.report.evaluation import POSITION_LIMIT_UM
from cmp_tactile_processing.geometry.rectification import read_camera_info
from cmp_tactile_processing.sensor.description import SensorDescription

TUTORIAL = Path(__file__).resolve().parents[3] / "docs" / "tutorials" / "calibrate.md"
FAILS = "# exit code 1"
# These run until Ctrl-C, and have tests of their own.
ENDLESS = ("replay", "live")


def words(line):
    """The arguments of a command line, without `cmp_tactile` and without comments."""
    program, *arguments = shlex.split(line, comments=True)
    assert program == "cmp_tactile"
    return arguments


PRACTICE = TUTORIAL.read_text(encoding="utf-8")


def test_the_tutorial_ends_with_a_working_sensor(practice_set, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    first, *others = shell_lines(PRACTICE)
    assert words(first) == ["calibrate", "practice", "--output", "practice"]
    (tmp_path / "practice").symlink_to(practice_set)
    shown = {}
    for line in others:
        if words(line)[0] in ENDLESS:
            continue
        assert main(words(line)) == (1 if FAILS in line else 0), line
        shown[line] = capsys.readouterr().out
    for line, text in shown.items():
        if "calibrate" in line and "truth" not in line:
            assert_outline_shown(line, text)
    assert sum(FAILS in line for line in others) == 1
    before, after, true = (text for line, text in shown.items() if "calibrate check" in line)
    assert "missed" in before
    assert "missed" not in after
    assert true_error_um(after) < POSITION_LIMIT_UM < 100 * POSITION_LIMIT_UM
    assert true_error_um(before) > 100 * POSITION_LIMIT_UM
    assert true_error_um(true) < POSITION_LIMIT_UM
    assert_found(SensorDescription.load("my_sensor.yaml"), practice_set)
    assert (tmp_path / "my_sensor_calibration" / "index.html").is_file()
    assert (tmp_path / "results" / "contact.mcap").is_file()


def assert_outline_shown(line, printed):
    """Numbers and what is determined are those of another rig; headings, quantities, files are not.

    Cells of a table wrap as their numbers and the terminal let them.
    """
    shown = shown_after(TUTORIAL, line)
    outline = re.compile(r"Parameter|sample_rig|(left|right) view|Accepted|Figures|Written")
    named = [text for text in shown if outline.match(text)]
    assert_printed(named, printed, absolute=np.inf, whole=False)
    quantities = {text.split("│")[1] for text in shown if text.startswith("│")}
    assert set(" ".join(quantities).split()) <= set(printed.split())


def true_error_um(table):
    """The mean 3-D error that a check reports, um."""
    row = next(line for line in table.splitlines() if "3-D error against" in line)
    value, unit = re.search(r"([0-9.]+) ([um]m), ", row).groups()
    return float(value) * {"um": 1, "mm": 1000}[unit]


def assert_found(sensor, practice_set):
    """What the calibration must have found of a rig that differs by 1 % in focal length."""
    true = SensorDescription.load(practice_set / "truth" / "sensor.yaml")
    nominal = SensorDescription.load(practice_set / "sensor.yaml")
    assert abs(true.camera.fx / nominal.camera.fx - 1) == pytest.approx(0.01)
    assert sensor.camera.fx == pytest.approx(true.camera.fx, rel=1e-3)
    assert sensor.calibration.method == "gel"
    assert "camera.fx" in sensor.calibration.determined
    name, info = read_camera_info(Path("my_sensor_right.yaml"))
    assert name == f"{sensor.name}_right"
    assert info.P[0, 3] < 0
    np.testing.assert_allclose(info.K[0, 0], sensor.camera.fx)
