"""`cmp_tactile process` in several processes and on a cluster: the same bytes, errors in order."""

import os
import shutil
import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest
from command_output import run
from waiting import wait_until

from cmp_tactile_bringup.offline import pools
from cmp_tactile_processing.errors import OutputError

MADE = (".mcap", "_wrench.csv")


process = partial(run, "process", "--sensor", "sample_rig")


def error_lines(capsys):
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]


def same_files(folder, other, names):
    for name in names:
        for suffix in MADE:
            path = folder / f"{name}{suffix}"
            assert path.read_bytes() == (other / path.name).read_bytes(), path.name


def test_processes_give_the_same_bytes_and_one_bad_recording_stops_no_other(
    recording, images, tmp_path, capsys
):
    (tmp_path / "empty").mkdir()
    sources = (images, recording.bag, tmp_path / "empty")
    assert process(*sources, "--output", tmp_path / "out", "--jobs", 2) == 1
    (error,) = error_lines(capsys)
    assert "empty: found nothing" in error
    assert process(*sources[:2], "--output", tmp_path / "here", "--jobs", 1) == 0
    same_files(tmp_path / "here", tmp_path / "out", ("images", "grasp"))


def test_a_process_that_dies_is_reported_and_what_it_left_is_removed(
    recording, images, tmp_path, capsys
):
    """As where the system ends a process that wants too much memory."""
    out = tmp_path / "out"

    def writers():
        for handle in Path("/proc").glob("[0-9]*/fd/*"):
            with suppress(OSError):
                # Another test may write results of the same name at this moment.
                if handle.readlink().is_relative_to(out / ".grasp.partial"):
                    yield int(handle.parts[2])

    def kill_the_process_of_the_bag():
        wait_until(lambda: list(writers()), "the bag's results")
        for number in set(writers()):
            os.kill(number, signal.SIGKILL)

    with ThreadPoolExecutor(1) as pool:
        killer = pool.submit(kill_the_process_of_the_bag)
        assert process(recording.bag, images, "--output", out, "--jobs", 2) == 1
        killer.result()
    assert f"{recording.bag}: a process ended early" in error_lines(capsys)[0]
    assert not list(out.glob("*grasp*"))


def test_a_worker_runs_nothing_of_the_current_folder(tmp_path, monkeypatch, capsys):
    for name in (*sys.stdlib_module_names, "numpy", "yaml", "cmp_tactile_bringup"):
        (tmp_path / f"{name}.py").write_text("open(__file__ + '.ran', 'w').close()")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "images").mkdir()
    for name in "ab":
        (tmp_path / "images" / name).mkdir()
    folders = (tmp_path / "images" / "a", tmp_path / "images" / "b")
    assert process(*folders, "--output", tmp_path / "out", "--jobs", 2) == 1
    assert ["found nothing" in line for line in error_lines(capsys)] == [True, True]
    assert not list(tmp_path.glob("*.ran"))
    assert Path.cwd() == tmp_path


@pytest.fixture
def cluster():
    """Address of a dask scheduler with two processes as workers."""
    distributed = pytest.importorskip("distributed")
    local = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address=None,
        worker_dashboard_address=None,
    )
    with local:
        yield local.scheduler_address


def test_a_cluster_gives_the_same_bytes(cluster, images, tmp_path, capsys):
    for k in range(3):
        shutil.copy(images / f"{k}.png", tmp_path / f"i{k}.png")
    sources = [tmp_path / f"i{k}.png" for k in range(3)]
    (tmp_path / "empty").mkdir()
    more = (*sources[:2], tmp_path / "empty", sources[2])
    assert process(*more, "--output", tmp_path / "out", "--scheduler", cluster) == 1
    (error,) = error_lines(capsys)
    assert "empty: found nothing" in error
    assert process(*sources, "--output", tmp_path / "here") == 0
    same_files(tmp_path / "here", tmp_path / "out", ("i0", "i1", "i2"))


def test_no_scheduler_and_no_dask_are_reported(images, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(pools, "SECONDS_TO_CONNECT", 0.2)
    nowhere = ("--output", tmp_path / "out", "--scheduler", "tcp://127.0.0.1:1")
    assert process(images, *nowhere) == 1
    assert "error: tcp://127.0.0.1:1: found no dask scheduler" in error_lines(capsys)[0]
    assert process(images, "--output", tmp_path, "--scheduler", "nonsense://x") == 1
    assert "error: nonsense://x: found no dask scheduler" in error_lines(capsys)[0]
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert process(images, *nowhere) == 1
    assert "error: --scheduler: found no dask" in error_lines(capsys)[0]


def test_compiling_is_left_to_another_process_and_done_once(tmp_path, monkeypatch):
    """What was compiled here would give other bits than what is taken from the cache."""
    from cmp_tactile_bringup.offline.processor import compile_elsewhere
    from cmp_tactile_processing.sensor.description import find_sensor_description
    from cmp_tactile_processing.stereo.triangulation import _triangulate

    # A folder of links to what is compiled, in which nothing says so.
    for path in Path(_triangulate.stats.cache_path).parent.iterdir():
        if path.is_dir():
            (tmp_path / path.name).symlink_to(path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    stages = []
    for _ in range(2):
        compile_elsewhere(
            find_sensor_description("sample_rig"), lambda what, _share: stages.append(what)
        )
    assert stages == ["compiling, once per version"]
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("version: 1")
    (done,) = tmp_path.glob("pipeline-*")
    done.unlink()
    with pytest.raises(OutputError, match="cannot be built"):
        compile_elsewhere(wrong, lambda _what, _share: None)
    assert not list(tmp_path.glob("pipeline-*"))
