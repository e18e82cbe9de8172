"""`cmp_tactile process` in several processes and on a cluster: the same bytes, errors in order."""

import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from multiprocessing import active_children
from pathlib import Path

import pytest

from cmp_tactile_bringup.command import main
from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_bringup.offline.display import Display

MADE = (".mcap", "_wrench.csv")


def process(*arguments):
    return main(["process", "--sensor", "sample_rig", *map(str, arguments)])


def error_lines(capsys):
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]


def same_files(folder, other, names):
    for name in names:
        for suffix in MADE:
            path = folder / f"{name}{suffix}"
            assert path.read_bytes() == (other / path.name).read_bytes(), path.name


def test_processes_give_the_same_bytes_and_one_that_dies_takes_only_its_own(
    recording, images, tmp_path, capsys, monkeypatch
):
    """As where the system ends a process that wants too much memory, whenever it is tried."""
    (tmp_path / "empty").mkdir()
    shutil.copy(images / "2.png", images.parent / "last.png")
    show = Display.show

    def kill_the_process_of_the_bag(self, number, event, value):
        show(self, number, event, value)
        if number == 1 and event == "frames":
            for worker in holders_of_the_lock() - {os.getpid()}:
                os.kill(worker, signal.SIGKILL)

    def holders_of_the_lock():
        numbers = [lock.stat().st_ino for lock in (tmp_path / "out").glob(".grasp.lock")]
        rows = [line.split() for line in Path("/proc/locks").read_text().splitlines()]
        return {int(row[4]) for row in rows for n in numbers if row[5].endswith(f":{n}")}

    monkeypatch.setattr(Display, "show", kill_the_process_of_the_bag)
    sources = (images, recording.bag, tmp_path / "empty", images.parent / "last.png")
    assert process(*sources, "--output", tmp_path / "out", "--jobs", 2) == 1
    # As they end.
    errors = sorted(error_lines(capsys), key=lambda line: "empty" in line)
    assert len(errors) == 2
    assert f"{recording.bag}: its process ended early, twice" in errors[0]
    assert "empty: found no image" in errors[1]
    assert not (tmp_path / "out" / "grasp.mcap").exists()
    assert not active_children()
    assert process(images, sources[3], "--output", tmp_path / "here", "--jobs", 1) == 0
    same_files(tmp_path / "here", tmp_path / "out", ("images", "last"))


def test_ctrl_c_ends_all_processes(images, recording, tmp_path, monkeypatch):
    def interrupt(self, number, event, value):
        if event == "frames":
            raise KeyboardInterrupt

    monkeypatch.setattr(Display, "show", interrupt)
    sources = (recording.bag, images)
    assert process(*sources, "--output", tmp_path / "out", "--jobs", 2) == 130
    assert not active_children()
    assert not list((tmp_path / "out").glob("*grasp*"))


def test_a_worker_runs_nothing_of_the_current_folder(tmp_path, monkeypatch, capsys):
    for name in (*sys.stdlib_module_names, "numpy", "yaml", "cmp_tactile_bringup"):
        (tmp_path / f"{name}.py").write_text("open(__file__ + '.ran', 'w').close()")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "images").mkdir()
    for name in "ab":
        (tmp_path / "images" / name).mkdir()
    folders = (tmp_path / "images" / "a", tmp_path / "images" / "b")
    assert process(*folders, "--output", tmp_path / "out", "--jobs", 2) == 1
    assert ["found no image" in line for line in error_lines(capsys)] == [True, True]
    assert not list(tmp_path.glob("*.ran"))


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


def test_a_cluster_gives_the_same_bytes_and_refuses_workers_that_cannot(
    cluster, images, tmp_path, capsys
):
    for k in range(3):
        shutil.copy(images / f"{k}.png", tmp_path / f"i{k}.png")
    sources = [tmp_path / f"i{k}.png" for k in range(3)]
    (tmp_path / "empty").mkdir()
    more = (*sources[:2], tmp_path / "empty", sources[2])
    assert process(*more, "--output", tmp_path / "out", "--scheduler", cluster) == 1
    (error,) = error_lines(capsys)
    assert "empty: found no image" in error
    assert process(*sources, "--output", tmp_path / "here") == 0
    same_files(tmp_path / "here", tmp_path / "out", ("i0", "i1", "i2"))

    from distributed import Client

    with worker_without_the_package(cluster):
        with Client(cluster) as client:
            client.wait_for_workers(3, timeout=120)
        assert process(sources[0], "--output", tmp_path / "x", "--scheduler", cluster) == 1
        (error,) = error_lines(capsys)
        assert "error: worker tcp://127.0.0.1:" in error
        assert "found no cmp_tactile_bringup (No module named 'cmp_tactile_bringup')" in error


@contextmanager
def worker_without_the_package(address):
    """A dask worker in the same Python, without what this workspace has built."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    quiet = ("--nthreads", "1", "--no-dashboard", "--no-nanny", "--death-timeout", "120")
    child = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_worker", address, *quiet],
        env=environment,
        cwd="/",
        stderr=subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        child.kill()
        child.wait()


def test_no_scheduler_and_no_dask_are_reported(images, tmp_path, capsys, monkeypatch):
    from cmp_tactile_bringup.offline import cluster

    monkeypatch.setattr(cluster, "SECONDS_TO_CONNECT", 0.2)
    nowhere = ("--output", tmp_path / "out", "--scheduler", "tcp://127.0.0.1:1")
    assert process(images, *nowhere) == 1
    assert "error: tcp://127.0.0.1:1: found no dask scheduler" in error_lines(capsys)[0]
    assert process(images, "--output", tmp_path, "--scheduler", "nonsense://x") == 1
    assert "error: nonsense://x: found no dask scheduler" in error_lines(capsys)[0]
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert process(images, *nowhere) == 1
    assert "error: --scheduler: found no dask" in error_lines(capsys)[0]


def test_files_that_a_worker_does_not_see_are_named(tmp_path):
    """The machines of a cluster must share their files."""
    from cmp_tactile_bringup.offline.cluster import unseen_file
    from cmp_tactile_bringup.offline.jobs import Job, Options, Task

    job = Job("bag", str(tmp_path / "bag"), str(tmp_path), "bag", str(tmp_path))
    assert unseen_file(Task(job, Options()), "tcp://far:1").startswith(
        f"{tmp_path / 'bag'}: found no such file or folder on the worker tcp://far:1, expected"
    )


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
    assert stages == ["compiling, once per version of the software"]
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("version: 1")
    (done,) = tmp_path.glob("pipeline-*")
    done.unlink()
    with pytest.raises(OutputError, match="cannot be built"):
        compile_elsewhere(wrong, lambda _what, _share: None)
    assert not list(tmp_path.glob("pipeline-*"))
