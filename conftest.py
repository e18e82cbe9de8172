"""What holds for all tests of the repository."""

from __future__ import annotations

import importlib
import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from ros_graph import RosGraph

# Modules in test/plugins.
pytest_plugins = ("parallel_run", "required_ros")

# Before numpy is loaded, here and in processes that tests start: BLAS threads wait for one another
# by spinning, and where another process has a core, matrices of a thousand rows take a hundred
# times as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Where a shell forbids to keep byte code, every process that a test starts would compile all
# sources again, and every worker all tests.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A package's folder and its module have the same name. Once the module is loaded, pytest does not
# take the folder for it.
for _name in (
    "cmp_tactile_bringup",
    "cmp_tactile_driver",
    "cmp_tactile_processing",
    "cmp_tactile_simulation",
    "cmp_tactile_viewer",
):
    importlib.import_module(_name)

_ROS_IS_THERE = importlib.util.find_spec("rclpy") is not None
_MADE_AHEAD = Path(__file__).parent / "test" / "plugins" / "made_ahead.py"


@pytest.fixture
def short_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The name `grasp` means a scene of 20 frames, here and in processes that the test starts."""
    from made_ahead import with_short_scenes

    with_short_scenes(monkeypatch)


@pytest.fixture(scope="session")
def grasp_bag() -> Path:
    """The recording of that scene; simulated in the first run, then from the cache folder."""
    from made_ahead import short_recording

    return short_recording("grasp")


@pytest.fixture(scope="session")
def packaged_grasp() -> Path:
    """The recording of the demo, which the documents show; as `grasp_bag`."""
    from cmp_tactile_simulation.recording.run import recording_of

    return recording_of("grasp")


@pytest.fixture(scope="session")
def weigh_bag() -> Path:
    """The recording of the short scene `weigh`; simulated in the first run, then from the cache."""
    from made_ahead import short_recording

    return short_recording("weigh")


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Makes what many tests read once for all workers: a path of that name, filled by `make`."""
    from cmp_tactile_processing.cache.files import locked

    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # of all workers of this run

    def made(name: str, make: Callable[[Path], object]) -> Path:
        place = base / "made_once" / name
        place.parent.mkdir(exist_ok=True)
        with locked(place.with_suffix(".lock")):
            if not place.exists():
                # Not half of it, where making it fails.
                new = Path(tempfile.mkdtemp(dir=base)) / name
                make(new)
                new.rename(place)
        return place

    return made


@pytest.fixture
def ros() -> Iterator[RosGraph]:
    """A ROS graph for one test."""
    graph = RosGraph()
    yield graph
    graph.close()


def pytest_configure() -> None:
    """Let Ctrl-C reach what the tests start."""
    # A shell starts background jobs with SIGINT ignored, and what they start inherits that: the
    # tests of Ctrl-C would wait without end.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile what is not in the caches: every worker would do it for itself, at the same time."""
    from parallel_run import gives_out_work

    if gives_out_work(session.config):
        session.config.get_terminal_writer().line("compiling ahead of the workers")
        from cmp_tactile_processing.processes import python_command

        command = python_command("cmp_tactile_processing.prepare", "sample_rig", "--only")
        parts = (["trackers", "stereo"], ["forces"])
        for process in [subprocess.Popen([*command, *part]) for part in parts]:
            process.wait()
        recordings = subprocess.Popen([sys.executable, str(_MADE_AHEAD)])
        session.config.add_cleanup(recordings.terminate)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Without ROS 2, skip what needs it."""
    if not _ROS_IS_THERE:
        for item in items:
            if item.get_closest_marker("ros"):
                item.add_marker(
                    pytest.mark.skip(reason="ROS 2 is not there: 'make test' sets it up")
                )
