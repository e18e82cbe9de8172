"""`cmp_tactile process` that is interrupted, given again, or run out of room."""

import errno
import os
import resource
import shutil
import signal
import subprocess
import sys
from functools import partial

import pytest
from command_output import run
from waiting import wait_until

from cmp_tactile_bringup.offline.processor import Processor

FILES = [".mcap", ".yaml", "_wrench.csv"]


process = partial(run, "process", "--sensor", "sample_rig")


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_existing_results_are_replaced_only_if_asked(images, tmp_path, capsys):
    out = tmp_path / "out"
    assert process(images / "0.png", "--output", out, "--arrays") == 0
    before = contents(out)
    again = (images / "0.png", images / "1.png", "--output", out, "--views", "left")
    assert process(*again) == 1
    assert f"{out / '0.mcap'}: exists already; --overwrite replaces it" in capsys.readouterr().err
    # The others are made.
    assert contents(out).items() > before.items()
    assert (out / "1.mcap").exists()
    assert process(*again, "--overwrite") == 0
    assert contents(out)["0.mcap"] != before["0.mcap"]
    # What the new options do not make is not left lying beside what they make.
    assert not (out / "0.npz").exists()


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, 130)]
)
def test_nothing_half_is_there_and_the_rest_is_made(recording, images, tmp_path, number, code):
    """`kill -9`, a power cut, or Ctrl-C, which the terminal gives to all processes."""
    out = tmp_path / "out"
    sources = [str(images / "0.png"), str(recording.bag)]
    command = [sys.executable, "-m", "cmp_tactile_bringup.command", "process", *sources]
    jobs = "1" if number == signal.SIGKILL else "2"
    options = ["--sensor", "sample_rig", "--output", str(out), "--jobs", jobs]
    with subprocess.Popen(
        [*command, *options], stderr=subprocess.DEVNULL, start_new_session=True
    ) as child:
        table = out / ".grasp.partial" / "grasp_wrench.csv"
        wait_until(lambda: table.exists() or child.poll() is not None, "the second table")
        os.killpg(child.pid, number)
    assert child.returncode == code
    made = {path.name for path in out.iterdir() if not path.name.startswith(".")}
    # With two processes, the first may be at work as well.
    assert made in (set(), {f"0{suffix}" for suffix in FILES})
    assert process(*sources, "--output", out, "--jobs", 1) == int(bool(made))
    assert process(recording.bag, "--output", tmp_path / "whole") == 0
    found, whole = contents(out), contents(tmp_path / "whole")
    assert found.keys() == {f"0{suffix}" for suffix in FILES} | whole.keys()
    assert found.items() >= whole.items()


def test_ctrl_c_ends_with_130_and_leaves_what_is_finished(images, tmp_path, monkeypatch):
    run = Processor.run

    def interrupted(self, folder, on_share):
        outcome = run(self, folder, on_share)
        if folder.name == ".images.partial":
            raise KeyboardInterrupt
        return outcome

    out = tmp_path / "out"
    monkeypatch.setattr(Processor, "run", interrupted)
    sources = (images / "0.png", images, images / "1.png")
    assert process(*sources, "--output", out, "--jobs", 1) == 130
    assert [path.name for path in sorted(out.iterdir())] == [f"0{suffix}" for suffix in FILES]


def test_a_full_disk_is_that_of_the_output(images, tmp_path, capsys, monkeypatch):
    """Linux's copy names the file that it reads first, as if that were at fault."""

    def copy(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), source, None, target)

    monkeypatch.setattr(shutil, "copyfile", copy)
    assert process(images, "--output", tmp_path / "out") == 1
    said = capsys.readouterr().err
    assert f"{tmp_path / 'out'}: its disk: No space left on device" in said
    assert "sample_rig.yaml" not in said


def test_no_room_is_reported_and_nothing_is_left(images, tmp_path, capsys):
    """The system refuses to let the file grow, as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        assert process(images, "--output", tmp_path / "out") == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "images.mcap: cannot be written: File too large" in capsys.readouterr().err
    assert not list((tmp_path / "out").iterdir())
