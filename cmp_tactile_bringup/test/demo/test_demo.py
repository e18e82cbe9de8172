"""The demo names limits that were missed."""

from __future__ import annotations

import re
from dataclasses import replace

import cmp_tactile_bringup.demo
from cmp_tactile_bringup.command import main


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
    monkeypatch.setattr("cmp_tactile_bringup.report.write.write_report", lambda *_: None)
    bag = str(results.recording.bag)
    assert main(["demo", "--rate", "20", "--recording", bag, "--output", str(tmp_path)]) == 1
    (missed,) = re.findall("Limits missed: (.*)", capsys.readouterr().out)
    # And the frames that are not among the results.
    assert missed == "Frames lost, Corners not found, Corner error, RMS"
