"""What a run leaves where it is interrupted, where it may write, and what it replaces."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing.cache.files import locked
from cmp_tactile_processing.errors import ContactError, OutputError
from cmp_tactile_simulation.recording.run import RunOptions, run_scene
from cmp_tactile_simulation.scenes.file import load_scene, write_scene

PNG = RunOptions(format="png")
FRAMES = 9


def stop_at(frame, total=FRAMES, error=KeyboardInterrupt):
    def on_progress(what, share):
        if what == "simulating" and share > (frame - 0.5) / total:
            raise error

    return on_progress


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def scene(small_scene):
    return small_scene()


@pytest.mark.parametrize("kind", ["bag", "png"])
def test_after_ctrl_c_the_frames_are_read_and_the_same_run_starts_again(kind, scene, tmp_path):
    options = RunOptions(format=kind)
    with pytest.raises(KeyboardInterrupt):
        run_scene(scene, tmp_path / "out", options, progress=stop_at(5))
    with Reader(tmp_path / "out") as reader:
        assert reader.message_count == 7 * 5
    assert BagReader(tmp_path / "out").health.problem == ""
    assert run_scene(scene, tmp_path / "out", options) == FRAMES
    run_scene(scene, tmp_path / "whole" / "out", options)
    assert contents(tmp_path / "out") == contents(tmp_path / "whole" / "out")


KILLED = """
import os, signal, sys
from pathlib import Path
from cmp_tactile_simulation.recording.run import run_scene
from cmp_tactile_simulation.scenes.file import read_scene

def on_progress(what, share):
    if what == "simulating" and share > 0.6:
        os.kill(os.getpid(), signal.SIGKILL)

run_scene(read_scene(Path(sys.argv[1])), Path(sys.argv[2]), progress=on_progress)
"""


def test_a_killed_run_leaves_what_can_be_read(scene, tmp_path):
    write_scene(scene, tmp_path)
    target = tmp_path / "out"
    command = [sys.executable, "-c", KILLED, str(tmp_path / "scene.yaml"), str(target)]
    killed = subprocess.run(command, check=False)
    assert killed.returncode == -9
    reader = BagReader(target)
    # Killed when frame 6 was handed over to be written.
    assert 4 <= len(list(reader.frames())) <= 6
    assert "the file has no end" in reader.health.problem
    assert run_scene(scene, target) == FRAMES


@pytest.mark.parametrize("options", [RunOptions(), PNG])
def test_a_finished_output_is_kept_unless_it_may_be_replaced(options, scene, tmp_path):
    out = tmp_path / "out"
    run_scene(scene, out, RunOptions(format=options.format, frames=2))
    before = contents(out)
    with pytest.raises(OutputError, match="out: exists already; --overwrite replaces it"):
        run_scene(scene, out, options)
    assert contents(out) == before
    replaced = RunOptions(format=options.format, frames=3, overwrite=True)
    assert run_scene(scene, out, replaced) == 3
    assert contents(out) != before


@pytest.mark.parametrize("deleted", [0, 1, 2])
def test_a_run_killed_while_it_replaces_another_leaves_an_unfinished_output(
    deleted, scene, tmp_path, monkeypatch
):
    out = tmp_path / "out"
    run_scene(scene, out, RunOptions(frames=2))
    unlink, calls = Path.unlink, []

    def killed_unlink(path, missing_ok=False):
        if path.parent == out:
            calls.append(path)
            if len(calls) > deleted:
                raise KeyboardInterrupt
        unlink(path, missing_ok)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", killed_unlink)
        with pytest.raises(KeyboardInterrupt):
            run_scene(scene, out, RunOptions(frames=3, overwrite=True))
    # A finished one would be refused.
    assert run_scene(scene, out, RunOptions(frames=3)) == 3


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["notes.txt", "scene.yaml", "photos"])
def test_a_folder_of_something_else_is_left_alone(name, overwrite, scene, tmp_path):
    """Even one with a scene.yaml, as where scenes are written: nothing of it is deleted."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.yaml").write_text("mine")
    if name == "photos":
        (out / name).mkdir()
    else:
        (out / name).write_text("version: 1")
    before = sorted(out.rglob("*"))
    with pytest.raises(OutputError, match=r"out: found .*, expected a simulated recording or"):
        run_scene(scene, out, RunOptions(overwrite=overwrite))
    assert sorted(out.rglob("*")) == before


def test_two_processes_do_not_write_the_same_output(scene, tmp_path):
    busy = pytest.raises(OutputError, match="out: is being written by another process")
    with locked(tmp_path / ".out.lock"), busy:
        run_scene(scene, tmp_path / "out")
    run_scene(scene, tmp_path / "out", RunOptions(frames=1))


def test_a_scene_that_fails_leaves_its_good_frames(small_scene, tmp_path):
    motion = [
        {"name": "press", "frames": 2, "load": {"normal": 0.5}},
        {"name": "tear", "frames": 1, "load": {"normal": 0.5, "tangential": [5, 0]}},
    ]
    expected = r"phase 'tear', frame 2: .*expected normal 0\.5 N, tangential \(5, 0\) N"
    with pytest.raises(ContactError, match=expected):
        run_scene(small_scene(motion=motion), tmp_path / "out")
    assert len(list(BagReader(tmp_path / "out").frames())) == 2


@pytest.fixture
def block(tmp_path):
    """Indenter of a scene: a mesh file, in mm."""
    import trimesh

    mesh = tmp_path / "block.stl"
    trimesh.creation.box((8.0, 8.0, 4.0)).export(mesh)
    return {"type": "mesh", "file": str(mesh), "scale": 0.001}


def test_a_mesh_goes_with_the_recording(block, small_scene, tmp_path):
    scene = small_scene(indenter=block)
    run_scene(scene, tmp_path / "out", RunOptions(frames=2))
    assert (tmp_path / "out" / "block.stl").read_bytes() == Path(block["file"]).read_bytes()
    again = load_scene(str(tmp_path / "out" / "scene.yaml"))
    run_scene(again, tmp_path / "again" / "out", RunOptions(frames=2))
    assert contents(tmp_path / "again" / "out") == contents(tmp_path / "out")
    # What a user put there stays.
    (tmp_path / "out" / "notes.txt").write_text("mine")
    run_scene(small_scene(), tmp_path / "out", RunOptions(frames=1, overwrite=True))
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"


def test_another_mesh_takes_the_place_of_the_first(block, small_scene, tmp_path):
    run_scene(small_scene(indenter=block), tmp_path / "out", RunOptions(frames=1))
    renamed = Path(block["file"]).rename(tmp_path / "other.stl")
    other = small_scene(indenter=block | {"file": str(renamed)})
    run_scene(other, tmp_path / "out", RunOptions(frames=1, overwrite=True))
    assert [path.name for path in (tmp_path / "out").glob("*.stl")] == ["other.stl"]
    run_scene(small_scene(), tmp_path / "out", RunOptions(frames=1, overwrite=True))
    assert not list((tmp_path / "out").glob("*.stl"))


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["scene.yaml", "block.stl"])
def test_what_is_read_is_not_written_over(name, overwrite, block, small_scene, tmp_path):
    """A recording's own scene, and another scene with the recording's mesh."""
    out = tmp_path / "out"
    run_scene(small_scene(indenter=block), out, RunOptions(frames=1))
    before = contents(out)
    if name == "scene.yaml":
        scene = load_scene(str(out / name))
    else:
        scene = small_scene(indenter=block | {"file": str(out / name)})
    expected = f"out: contains the input {out / name}; .*--output"
    with pytest.raises(OutputError, match=expected):
        run_scene(scene, out, RunOptions(overwrite=overwrite))
    assert contents(out) == before


def test_a_full_disk_is_reported_with_its_folder(scene, tmp_path):
    """Tried: "No space left on device", and no word of where."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill_disk(_what, _share):
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))

    try:
        with pytest.raises(OutputError, match=r"out/out\.mcap: cannot be written: File too"):
            run_scene(scene, tmp_path / "out", progress=fill_disk)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
