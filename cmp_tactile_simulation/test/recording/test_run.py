"""Runs that are interrupted go on where they stopped, and end with the same bytes."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest
from rosbags.rosbag2 import Reader

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing.cache.files import locked
from cmp_tactile_simulation.errors import LoadError, OutputError
from cmp_tactile_simulation.recording.run import RunOptions, RunResult, run_scene
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


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory):
    """The outputs of a run in one go, by format; the folder's name is part of the bag."""
    folder = tmp_path_factory.mktemp("whole")
    run_scene(scene, folder / "bag" / "out")
    run_scene(scene, folder / "png" / "out", PNG)
    return {kind: contents(folder / kind / "out") for kind in ("bag", "png")}


@pytest.mark.parametrize("kind", ["bag", "png"])
@pytest.mark.parametrize("frame", [0, 5, 9])
def test_after_ctrl_c_the_same_run_goes_on(kind, frame, scene, whole, tmp_path):
    options = RunOptions(format=kind)
    with pytest.raises(KeyboardInterrupt):
        run_scene(scene, tmp_path / "out", options, progress=stop_at(frame))
    if kind == "bag" and frame:
        with Reader(tmp_path / "out") as reader:
            assert reader.message_count == 7 * frame
        assert BagReader(tmp_path / "out").loss == ""
    result = run_scene(scene, tmp_path / "out", options)
    assert result == RunResult(FRAMES, frame)
    assert contents(tmp_path / "out") == whole[kind]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


KILLED = """
import os, signal, sys
from pathlib import Path
from cmp_tactile_simulation.recording.run import RunOptions, run_scene
from cmp_tactile_simulation.scenes.file import read_scene

def on_progress(what, share):
    if what == "simulating" and share > float(sys.argv[4]):
        os.kill(os.getpid(), signal.SIGKILL)

scene = read_scene(Path(sys.argv[1]))
run_scene(scene, Path(sys.argv[2]), RunOptions(format=sys.argv[3]), progress=on_progress)
"""


@pytest.mark.parametrize("kind", ["bag", "png"])
def test_a_killed_run_leaves_what_can_be_read_and_goes_on(kind, scene, whole, tmp_path):
    write_scene(scene, tmp_path)
    target = tmp_path / "out"
    command = [sys.executable, "-c", KILLED, str(tmp_path / "scene.yaml"), str(target), kind, "0.6"]
    killed = subprocess.run(command, check=False)
    assert killed.returncode == -9
    if kind == "bag":
        reader = BagReader(target)
        read = len(list(reader.frames()))
        # Killed when frame 6 was handed over to be written.
        assert 4 <= read <= 6
        assert "the file has no end" in reader.loss
    result = run_scene(scene, target, RunOptions(format=kind))
    assert 4 <= result.resumed <= 6
    assert contents(target) == whole[kind]


def test_a_damaged_checkpoint_costs_a_frame(scene, whole, tmp_path, caplog):
    with pytest.raises(KeyboardInterrupt):
        run_scene(scene, tmp_path / "out", progress=stop_at(5))
    path = tmp_path / "out" / ".unfinished" / "state_00000004.npz"
    path.write_bytes(path.read_bytes()[:-400])
    assert run_scene(scene, tmp_path / "out") == RunResult(FRAMES, 4)
    assert contents(tmp_path / "out") == whole["bag"]
    assert "state_00000004.npz: cannot be used" in caplog.text


DIFFERENCES = {
    "seed": ({"seed": 5}, RunOptions(), "scene.seed 3, not 5"),
    "length": ({}, RunOptions(frames=7), "frames 9, not 7"),
    "format": ({}, PNG, 'format "bag", not "png"'),
}


@pytest.mark.parametrize("what", DIFFERENCES)
def test_an_unfinished_run_of_another_kind_is_not_gone_on_with(what, small_scene, tmp_path):
    changes, options, difference = DIFFERENCES[what]
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run_scene(small_scene(), out, progress=stop_at(2))
    before = contents(out / ".unfinished")
    with pytest.raises(OutputError) as error:
        run_scene(small_scene(**changes), out, options)
    assert str(error.value).startswith(f"{out}: is an unfinished run with ")
    assert difference in str(error.value)
    assert str(error.value).endswith("; --overwrite starts again")
    assert contents(out / ".unfinished") == before


def test_overwriting_an_unfinished_run_starts_again(small_scene, scene, whole, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run_scene(small_scene(seed=5), tmp_path / "out", progress=stop_at(5))
    assert run_scene(scene, tmp_path / "out", RunOptions(overwrite=True)) == RunResult(FRAMES, 0)
    assert contents(tmp_path / "out") == whole["bag"]


@pytest.mark.parametrize("options", [RunOptions(), PNG])
def test_a_finished_output_is_kept_unless_it_may_be_replaced(options, scene, tmp_path):
    out = tmp_path / "out"
    run_scene(scene, out, RunOptions(format=options.format, frames=2))
    before = contents(out)
    with pytest.raises(OutputError, match="out: exists already; --overwrite replaces it"):
        run_scene(scene, out, options)
    assert contents(out) == before
    replaced = RunOptions(format=options.format, frames=3, overwrite=True)
    assert run_scene(scene, out, replaced) == RunResult(3, 0)
    assert contents(out) != before


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
    with pytest.raises(LoadError):
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
    # Another scene replaces it with its mesh; what a user put there stays.
    (tmp_path / "out" / "notes.txt").write_text("mine")
    run_scene(small_scene(), tmp_path / "out", RunOptions(frames=1, overwrite=True))
    assert not (tmp_path / "out" / "block.stl").exists()
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"


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
        with pytest.raises(OSError, match="File too large") as caught:
            run_scene(scene, tmp_path / "out", progress=fill_disk)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert caught.value.filename == str(tmp_path / "out")


def test_a_video_that_was_not_written_whole_is_reported(scene, tmp_path):
    """The size that files may have stands for a full disk; afterwards the same run goes on."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill_disk(what, _share):
        if what == "drawing the video":
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))

    options = RunOptions(format="png", video=True)
    try:
        with pytest.raises(OutputError, match=r"video\.mp4: found \d frames written, expected 9"):
            run_scene(scene, tmp_path / "out", options, progress=fill_disk)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list((tmp_path / "out").glob("*.mp4"))
    assert run_scene(scene, tmp_path / "out", options) == RunResult(FRAMES, FRAMES)
    assert (tmp_path / "out" / "video.mp4").stat().st_size > 20_000
