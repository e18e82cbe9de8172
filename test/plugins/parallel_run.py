"""Tests in several processes at once (`-n`): what each of these workers has for itself.

Every worker, with all that its tests start, has a ROS domain of its own. A test marked `alone`
runs while no other does.
"""

import fcntl
import os
import socket
import tempfile
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

# Each needs up to 2.5 GB.
MOST_WORKERS = 4
# The highest number whose ports are free everywhere.
LAST_DOMAIN = 101
# The ports of a domain (DDS interoperability wire protocol, 9.6.1.1).
_FIRST_PORT = 7400
_DOMAIN_PORTS = 250
_FOLDER = pytest.StashKey[str]()
_TURNS = pytest.StashKey["Turns"]()


def claim_domain(first: int) -> tuple[int, socket.socket]:
    """A ROS domain that nobody on this machine uses, the next from `first` on.

    Returns its number and the socket that claims it for as long as it is open: a DDS domain is a
    range of UDP ports, and the last of them is what only its 120th node would take.
    """
    for step in range(LAST_DOMAIN):
        domain = 1 + (first - 1 + step) % LAST_DOMAIN
        ports = range(*(_FIRST_PORT + _DOMAIN_PORTS * number for number in (domain, domain + 1)))
        claim = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            claim.bind(("127.0.0.1", ports[-1]))
        except OSError:
            claim.close()
            continue
        if not _used_ports() & set(ports[:-1]):
            return domain, claim
        claim.close()
    msg = f"none of the ROS domains 1 to {LAST_DOMAIN} is free on this machine"
    raise RuntimeError(msg)


def _used_ports() -> set[int]:
    lines = (
        line
        for table in ("udp", "udp6")
        if (path := Path("/proc/net", table)).exists()
        for line in path.read_text().splitlines()[1:]
    )
    return {int(line.split()[1].rpartition(":")[2], 16) for line in lines}


def gives_out_work(config: pytest.Config) -> bool:
    """Whether this process has workers that run the tests."""
    has_workers = getattr(config.option, "tx", None) and not hasattr(config, "workerinput")
    return bool(has_workers and not config.option.collectonly)


class Turns:
    """Who may run: any number of ordinary tests at a time, or one that wants to be alone.

    folder: the same for all workers.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @contextmanager
    def take(self, *, alone: bool) -> Iterator[None]:
        """Wait for the turn and hold it."""
        with (self._folder / "gate").open("w") as gate, (self._folder / "room").open("w") as room:
            # Who waits for the room stands in the gate, so that one who wants to be alone gets
            # there although the others come and go.
            fcntl.flock(gate, fcntl.LOCK_EX)
            fcntl.flock(room, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
            fcntl.flock(gate, fcntl.LOCK_UN)
            try:
                yield
            finally:
                # Closing would not do: a forked process that lives on has the file open, too.
                fcntl.flock(room, fcntl.LOCK_UN)


def pytest_configure(config: pytest.Config) -> None:
    """Keep the tests' ROS graph to this machine and apart from that of other runs and workers."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    first = int(os.environ.get("ROS_DOMAIN_ID") or os.getpid())
    domain, claim = claim_domain(first)
    config.add_cleanup(claim.close)
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    worker: dict[str, Any] | None = getattr(config, "workerinput", None)
    if worker is not None:
        config.stash[_TURNS] = Turns(Path(worker["cmp_tactile_turns"]))
    elif gives_out_work(config):
        folder = tempfile.TemporaryDirectory(prefix="cmp_tactile_turns_")
        config.add_cleanup(folder.cleanup)
        config.stash[_FOLDER] = folder.name


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Workers of `-n auto`: one more than processors, as many tests wait for other processes."""
    return min((os.cpu_count() or 1) + 1, MOST_WORKERS)


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Tell a worker where the turns are given out."""
    node.workerinput["cmp_tactile_turns"] = node.config.stash[_FOLDER]


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Run a test with its fixtures when it is its turn."""
    turns = item.config.stash.get(_TURNS, None)
    if turns is None:
        return (yield)
    with turns.take(alone=item.get_closest_marker("alone") is not None):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Numbers that a test records as properties are sent to the first process as Python's own."""
    report = yield
    report.user_properties = [
        (name, value.item() if isinstance(value, np.generic) else value)
        for name, value in report.user_properties
    ]
    return report
