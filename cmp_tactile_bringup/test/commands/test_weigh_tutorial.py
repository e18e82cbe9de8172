"""docs/tutorials/weigh.md: its commands do what it says, as they stand in it."""

import shlex
import subprocess
from pathlib import Path

import numpy as np
import pytest
from command_output import printed_by
from documents import assert_printed, blocks, shell_lines, shown_after

from cmp_tactile_bringup.command import main
from cmp_tactile_processing.sensor.description import SensorDescription

REPOSITORY = Path(__file__).resolve().parents[3]
TUTORIAL = REPOSITORY / "docs" / "tutorials" / "weigh.md"
PRACTICE = TUTORIAL.read_text(encoding="utf-8")
OWN = (TUTORIAL.parents[1] / "calibrate.md").read_text(encoding="utf-8")


def run(line, capsys):
    """What a command of the tutorial prints; it must end well."""
    program, *arguments = shlex.split(line)
    if program == "python3":
        return printed_by(*arguments)
    if program == "cmp_tactile":
        assert main(arguments) == 0, line
    else:
        # For its redirection.
        subprocess.run(["bash", "-c", line], check=True)
    return capsys.readouterr().out


def table(text):
    """Rows of what the example prints: frame, read, 2 std, true."""
    return np.array([line.split() for line in text.splitlines()[1:]], np.float64)


def assert_rows_shown(shown, printed):
    """The tutorial's rows, of other frames than here, where the same weight rests on the gel."""
    assert_printed(shown[:1], printed)
    rows, held = table(printed), (0, 200, 500)
    for _, read, bar, true in table("\n".join(shown)):
        if round(true, 1) in held:
            same = rows[np.abs(rows[:, 3] - true) < 0.1]
            # Half to twice the bar: the pixels' noise differs by the samples of a pixel.
            assert np.abs(same[:, 1] - read).min() <= 0.3 + 0.01 * true, (true, read)
            assert 0.5 < np.median(same[:, 2]) / bar < 2, (true, bar)


@pytest.mark.usefixtures("short_scenes")
def test_a_weight_is_read_back_and_two_weights_determine_an_unknown_gel(
    tmp_path, monkeypatch, weigh_bag, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "docs").symlink_to(REPOSITORY / "docs")
    (tmp_path / "weights.yaml").write_text(blocks(PRACTICE, "yaml")[0])
    first, *others = shell_lines(PRACTICE)
    assert first == "cmp_tactile simulate weigh --output weigh"
    (tmp_path / "weigh").symlink_to(weigh_bag)
    printed = {line: run(line, capsys) for line in others}
    described, wrong, weighed = (
        table(text) for line, text in printed.items() if line.startswith("python3")
    )
    for rows in (described, weighed):
        _, read, bar, true = rows.T
        assert true.max() == pytest.approx(500, abs=0.1)
        # Twice the standard deviation, in all frames but one of twenty; grams are rounded.
        assert (np.abs(read - true) <= bar + 0.1).mean() > 0.9
        # Two marks of a kitchen scale, and 1 %.
        assert np.abs(read - true).max() < 2 + 0.01 * 500
    for line, text in printed.items():
        if line.startswith("python3"):
            assert_rows_shown(shown_after(TUTORIAL, line), text)
        elif line.startswith("cmp_tactile calibrate"):
            # Half the frames on a coarser mesh: forces within 1 %, what follows of them within 3 %.
            assert_printed(shown_after(TUTORIAL, line), text, rel=0.03, absolute=0.15)
    assert wrong[:, 1].max() == pytest.approx(350, rel=0.02)
    # The new description knows how well its gel is known.
    held = described[:, 3] > 450
    assert (weighed[held, 2] < described[held, 2] / 4).all()
    assert (tmp_path / "results" / "weigh_wrench.csv").is_file()
    for picture in ("weigh.png", "weighed.png", "weighed_calibration/loads.png"):
        assert (tmp_path / picture).stat().st_size > 10_000
    record = SensorDescription.load("weighed.yaml").elastomer.calibration
    assert (record.method, record.samples) == ("weights", 2)


def test_the_file_of_weights_for_own_sensors_can_be_read(tmp_path):
    from cmp_tactile_bringup.calibration.loads import read_known_loads

    (tmp_path / "weights.yaml").write_text(blocks(OWN, "yaml")[0])
    loads, rest = read_known_loads(tmp_path / "weights.yaml")
    assert len(loads) == 4
    assert rest == (0, 0.5)
