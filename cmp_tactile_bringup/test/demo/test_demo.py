"""Which rate the demo plays at, and that it names limits that were missed."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from command_output import run
from rich.progress import Progress

import cmp_tactile_bringup.demo
from cmp_tactile_bringup.commands.demo import Demo, _play
from cmp_tactile_bringup.report.results import DemoResults


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch, results: DemoResults) -> list[float]:
    """Rates that were played at, on a machine that keeps all frames below 8 Hz."""
    rates = []
    count = len(results.recording.truth.stamp_ns)

    def play(_recording, _sensor, options, _progress):
        rates.append(options.rate_hz)
        kept = count if options.rate_hz < 8 else count - 2
        reached = min(options.rate_hz, 12.0)
        run = replace(results.run, frames_sent=count, asked_hz=options.rate_hz, rate_hz=reached)
        return replace(results, frames=results.frames[:1] * kept, run=run)

    monkeypatch.setattr(cmp_tactile_bringup.demo, "play", play)
    return rates


def test_a_limit_that_is_missed_is_named_and_ends_the_demo_with_one(
    results, monkeypatch, capsys, tmp_path
):
    """The corners of the left view 0.2 px beside where they are."""
    frames = tuple(
        replace(item, left=replace(item.left, corners=item.left.corners + (0.2, 0.0)))
        for item in results.frames
    )
    monkeypatch.setattr(
        cmp_tactile_bringup.demo, "play", lambda *_: replace(results, frames=frames)
    )
    monkeypatch.setattr("cmp_tactile_bringup.report.demo.write_report", lambda *_: None)
    bag = str(results.recording.bag)
    assert run("demo", "--rate", "20", "--recording", bag, "--output", tmp_path) == 1
    (missed,) = re.findall("Limits missed: (.*)", capsys.readouterr().out)
    # And the frames that are not among the results.
    assert missed == "Frames lost, Corners not found, Corner error, RMS"


def play(results: DemoResults, rate: float | None, folder: Path):
    options = Demo(rate=rate, output=folder)
    return _play(results.recording, results.sensor, options, Progress(disable=True))


def test_a_machine_that_loses_frames_plays_them_again_slower(results, played, tmp_path):
    found, lost = play(results, None, tmp_path)
    assert played == pytest.approx([20.0, 7.2])  # 0.6 of the 12 Hz at which results came
    assert lost == {20.0: 2}
    assert len(found.frames) == len(results.recording.truth.stamp_ns)


def test_a_rate_that_is_asked_for_stays(results, played, tmp_path):
    found, lost = play(results, 15.0, tmp_path)
    assert (played, lost) == ([15.0], {})
    assert len(found.frames) == len(results.recording.truth.stamp_ns) - 2


def test_a_machine_that_always_loses_frames_comes_to_an_end(results, monkeypatch, tmp_path):
    always = replace(results, frames=results.frames[:1])
    assert always.run.frames_sent > 1
    rates = []

    def lose(_recording, _sensor, options, _progress):
        rates.append(options.rate_hz)
        return always

    monkeypatch.setattr(cmp_tactile_bringup.demo, "play", lose)
    found, lost = play(results, None, tmp_path)
    assert rates == pytest.approx([20.0, 12.0, 7.2])  # the rate that results came at is unknown
    assert len(lost) == 2
    assert found is always
