"""What holds for all tests of the repository."""

from __future__ import annotations

import importlib
import importlib.util
import os
import signal
from collections.abc import Generator

import pytest

# A package's folder and its module have the same name. Once the module is loaded, pytest does not
# take the folder for it.
for _name in (
    "cmp_tactile_bringup",
    "cmp_tactile_driver",
    "cmp_tactile_processing",
    "cmp_tactile_simulation",
):
    importlib.import_module(_name)

_ROS_IS_THERE = importlib.util.find_spec("rclpy") is not None
_ROS_TESTS_PASSED = pytest.StashKey[int]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add --require-ros."""
    parser.addoption(
        "--require-ros",
        action="store_true",
        help="fail if a test marked ros is skipped or none of them runs",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Keep the tests' ROS graph to this machine and apart from that of other test runs."""
    config.stash[_ROS_TESTS_PASSED] = 0
    # A shell starts background jobs with SIGINT ignored, and what they start inherits that: the
    # tests of Ctrl-C would wait in vain.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Without ROS 2, skip what needs it."""
    if not _ROS_IS_THERE:
        for item in items:
            if item.get_closest_marker("ros"):
                item.add_marker(
                    pytest.mark.skip(reason="ROS 2 is not there: 'make test' sets it up")
                )


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """With --require-ros, make a module that skips itself a failed one."""
    report = yield
    if report.skipped and collector.config.getoption("--require-ros"):
        report.outcome = "failed"
        report.longrepr = f"{collector.nodeid}: skipped, but --require-ros was given"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """With --require-ros, make a skipped ROS test a failed one."""
    report = yield
    if item.get_closest_marker("ros"):
        if report.skipped and item.config.getoption("--require-ros"):
            report.outcome = "failed"
            report.longrepr = f"{item.nodeid}: skipped, but --require-ros was given"
        if report.when == "call" and report.passed:
            item.config.stash[_ROS_TESTS_PASSED] += 1
    return report


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """With --require-ros, fail if no ROS test ran at all."""
    if exitstatus == pytest.ExitCode.OK and _lacks_ros_tests(session.config):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """Say why the run failed though every test passed."""
    if _lacks_ros_tests(config):
        terminalreporter.write_line("no test marked ros passed, but --require-ros was given")


def _lacks_ros_tests(config: pytest.Config) -> bool:
    return config.getoption("--require-ros") and config.stash[_ROS_TESTS_PASSED] == 0
