"""`cmp_tactile process` that is interrupted, given again, or run out of room."""

import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import wait_until

from cmp_tactile_bringup.command import main
from cmp_tactile_bringup.offline.display import Display

FILES = [".mcap", "_process.json", "_wrench.csv"]


def process(*arguments):
    return main(["process", "--sensor", "sample_rig", *map(str, arguments)])


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_what_is_finished_is_kept_and_reported_again(images, tmp_path, capsys):
    """Also that frames were lost, and the exit code that this has."""
    (images / "1.png").write_bytes(b"")
    out = tmp_path / "out"
    assert process(images, "--output", out) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if "could not be used" in line]
    before = {path: path.stat().st_mtime_ns for path in out.iterdir()}
    assert [path.name.removeprefix("images") for path in sorted(before)] == FILES
    # A copy that was made meanwhile has other times, and the same content.
    os.utime(images / "0.png")
    assert process(images, "--output", out) == 1
    err = capsys.readouterr().err
    assert f"2 frames -> {out / 'images.mcap'}, finished before" in err
    assert [line for line in err.splitlines() if "could not be used" in line] == lines
    assert len(lines) == 1
    assert "1.png" in lines[0]
    assert {path: path.stat().st_mtime_ns for path in out.iterdir()} == before


@pytest.mark.parametrize("what", ["recording", "sensor", "options", "file"])
def test_results_of_something_else_are_replaced_only_if_asked(what, images, tmp_path, capsys):
    out, more = tmp_path / "out", []
    assert process(images / "0.png", "--output", out, "--arrays") == 0
    before = contents(out)
    words = f"made from another {what}"
    if what == "recording":
        (images / "0.png").write_bytes((images / "2.png").read_bytes())
    elif what == "sensor":
        words = "made from another sensor description and other options"
        more = ["--sensor", "prototype"]
    elif what == "options":
        words = "made from other options"
    else:
        words = "but 0_wrench.csv has changed since"
        (out / "0_wrench.csv").write_text("half a table")
        before = contents(out)
    again = (images / "0.png", "--output", out, *more)
    again = (*again, "--arrays") if what in ("recording", "file") else again
    assert process(*again) == 1
    assert f"0.mcap: exists already, {words}; --overwrite replaces it" in capsys.readouterr().err
    assert contents(out) == before
    if what != "sensor":
        assert process(*again, "--overwrite") == 0
        assert contents(out) != before
        # What the new options do not make is not left lying beside what they make.
        assert (out / "0.npz").exists() == (what != "options")


def test_after_a_kill_nothing_half_is_there_and_the_rest_is_made(recording, images, tmp_path):
    """As `kill -9` or a power cut ends it, in the middle of the second recording."""
    out = tmp_path / "out"
    sources = [str(images / "0.png"), str(recording.bag)]
    command = [sys.executable, "-m", "cmp_tactile_bringup.command", "process", *sources]
    options = ["--sensor", "sample_rig", "--output", str(out), "--jobs", "1"]
    child = subprocess.Popen([*command, *options], stderr=subprocess.DEVNULL)
    table = out / ".grasp.partial" / "_wrench.csv"
    wait_until(lambda: table.exists() or child.poll() is not None, "the second table")
    child.kill()
    assert child.wait() == -signal.SIGKILL
    made = {p.name: p.read_bytes() for p in out.iterdir() if not p.name.startswith(".")}
    assert sorted(made) == [f"0{suffix}" for suffix in FILES]
    assert process(*sources, "--output", out, "--jobs", 1) == 0
    assert process(recording.bag, "--output", tmp_path / "whole") == 0
    found = contents(out)
    assert sorted(found) == sorted(f"{name}{suffix}" for name in ("0", "grasp") for suffix in FILES)
    assert {name: found[name] for name in made} == made
    for name in ("grasp.mcap", "grasp_wrench.csv"):
        assert found[name] == (tmp_path / "whole" / name).read_bytes()


def test_complete_files_that_were_not_all_moved_are_moved_the_next_time(
    images, tmp_path, monkeypatch, capsys
):
    """The kill came between the two files."""
    out, replace = tmp_path / "out", Path.replace

    def killed_after_the_bag(self, target):
        if Path(target).name == "0_wrench.csv":
            raise KeyboardInterrupt
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", killed_after_the_bag)
    assert process(images / "0.png", "--output", out) == 128 + signal.SIGINT
    monkeypatch.undo()
    assert (out / "0.mcap").exists()
    assert not (out / "0_wrench.csv").exists()
    capsys.readouterr()
    assert process(images / "0.png", "--output", out) == 0
    assert "finished before" in capsys.readouterr().err
    assert [path.name for path in sorted(out.iterdir())] == [f"0{suffix}" for suffix in FILES]


def test_ctrl_c_ends_with_130_and_leaves_what_is_finished(images, tmp_path, monkeypatch):
    def interrupt(self, number, event, value):
        if number == 1 and event == "frames":
            raise KeyboardInterrupt

    out = tmp_path / "out"
    monkeypatch.setattr(Display, "show", interrupt)
    sources = (images / "0.png", images, images / "1.png")
    assert process(*sources, "--output", out, "--jobs", 1) == 130
    assert [path.name for path in sorted(out.iterdir())] == [f"0{suffix}" for suffix in FILES]


def test_no_room_is_reported_and_nothing_is_left(images, tmp_path, capsys):
    """The system refuses to let the file grow, as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        assert process(images, "--output", tmp_path / "out") == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert f"error: {images}: {tmp_path / 'out'}: File too large" in capsys.readouterr().err
    assert not list((tmp_path / "out").iterdir())


def test_two_runs_do_not_write_the_same_results_at_once(images, tmp_path, capsys, monkeypatch):
    from cmp_tactile_bringup.offline import result_files
    from cmp_tactile_processing.cache.files import locked

    monkeypatch.setattr(result_files, "SECONDS_FOR_LOCK", 0.0)
    with locked(tmp_path / ".images.lock"):
        assert process(images, "--output", tmp_path) == 1
    assert "images: another process" in capsys.readouterr().err


def test_a_damaged_record_counts_as_none(images, tmp_path, capsys):
    assert process(images / "0.png", "--output", tmp_path) == 0
    for text in ("", "[]", json.dumps({"version": 1}), "\0"):
        (tmp_path / "0_process.json").write_text(text)
        capsys.readouterr()
        assert process(images / "0.png", "--output", tmp_path) == 1
        assert "exists already, made from unknown" in capsys.readouterr().err


def test_a_recording_that_changes_while_it_is_read_is_read_again(images, tmp_path, monkeypatch):
    """Else what was read before the change would count as what is there now."""
    show = Display.show

    def changed_meanwhile(self, number, event, value):
        show(self, number, event, value)
        if event == "frames":
            (images / "0.png").write_bytes((images / "2.png").read_bytes())

    monkeypatch.setattr(Display, "show", changed_meanwhile)
    assert process(images / "0.png", "--output", tmp_path / "out") == 0
    monkeypatch.undo()
    assert process(images / "0.png", "--output", tmp_path / "out") == 1
