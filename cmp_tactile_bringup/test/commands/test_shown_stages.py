"""What takes long says so as it begins, also where no bar can move."""

import pytest

from cmp_tactile_bringup.graphs.packaged import load_graph
from cmp_tactile_bringup.graphs.recordings import with_recordings
from cmp_tactile_bringup.terminal.output import shown_stages


def test_in_a_pipe_each_stage_is_a_line_as_it_begins(capsys):
    """Reports of the kind, tried here:

    basicmachines-co/basic-memory 579 (74 s of silence where the output is captured, the bar at the
    end), smart-on-fhir/cumulus-etl 323 (nothing in a log file while it works): a line is there
    before the stage ends.
    """
    with shown_stages() as show:
        show("simulating", 0.0)
        assert "simulating ...\n" in capsys.readouterr().err
        show("simulating", 0.5)
        assert "simulating ..." not in capsys.readouterr().err
        show("drawing", 0.0)
        assert "drawing ...\n" in capsys.readouterr().err


class EnoughError(Exception):
    pass


def test_a_replay_of_a_scene_says_that_it_simulates_it_first(short_scenes, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    said = []

    def listen(what, _):
        said.append(what)
        if "simulating" in what:
            raise EnoughError

    with pytest.raises(EnoughError):
        with_recordings(load_graph("replay", {"input": "grasp"}), listen)
    assert all(what.startswith("grasp: ") for what in said)
    assert said[-1] == "grasp: simulating, the first time only"
