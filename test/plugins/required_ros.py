"""--require-ros: a test that needs ROS 2 and did not run makes the run a failed one."""

from collections.abc import Generator

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add --require-ros."""
    parser.addoption(
        "--require-ros",
        action="store_true",
        help="fail if a test marked ros is skipped or none of them runs",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Count where the reports of all workers come together."""
    if config.getoption("--require-ros") and not hasattr(config, "workerinput"):
        config.pluginmanager.register(_SomeMustPass(), "some-ros-tests-must-pass")


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Make a module that skips itself a failed one."""
    report = yield
    if report.skipped and collector.config.getoption("--require-ros"):
        report.outcome = "failed"
        report.longrepr = f"{collector.nodeid}: skipped, but --require-ros was given"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Make a skipped ROS test a failed one."""
    report = yield
    report.needs_ros = item.get_closest_marker("ros") is not None
    if report.needs_ros and report.skipped and item.config.getoption("--require-ros"):
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid}: skipped, but --require-ros was given"
    return report


class _SomeMustPass:
    """Fails the run if no test marked ros has passed."""

    def __init__(self) -> None:
        self._passed = 0

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" and report.passed and getattr(report, "needs_ros", False):
            self._passed += 1

    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        if exitstatus == pytest.ExitCode.OK and not self._passed:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if not self._passed:
            terminalreporter.write_line("no test marked ros passed, but --require-ros was given")
