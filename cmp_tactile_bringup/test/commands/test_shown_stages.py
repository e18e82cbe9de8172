"""What takes long says so as it begins, also where no bar can move."""

from cmp_tactile_bringup.terminal import shown_stages


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
