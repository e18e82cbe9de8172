"""What is printed: lines, tables and progress, for terminals, pipes and files.

And what a result was made with: packages, libraries, ROS and the machine.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from cmp_tactile_processing.errors import CmpTactileError, Finding, Severity, error_text, printable
from cmp_tactile_processing.processes import OnProgress

if TYPE_CHECKING:
    from cmp_tactile_bringup.report.results import TableRow

STYLES = {Severity.OK: "", Severity.WARNING: "yellow", Severity.ERROR: "bold red"}
RESULT_HEADINGS = ("Quantity", "Measured", "Limit", "")
# No line of ours is longer.
UNBOUNDED = 10_000

PACKAGES = ("cmp_tactile_processing", "cmp_tactile_driver", "cmp_tactile_bringup")
LIBRARIES = {
    "numpy": ("numpy",),
    "scipy": ("scipy",),
    "OpenCV": ("opencv-contrib-python-headless", "opencv-python-headless", "opencv-python"),
    "scikit-fem": ("scikit-fem",),
    "matplotlib": ("matplotlib",),
    "rosbags": ("rosbags",),
}


class _PipedConsole(Console):
    """Lets the work go on where the reader of the output has gone, as `| head` does."""

    def on_broken_pipe(self) -> None:
        """Write nothing more; rich would end the process with an exit code of 1."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())


class _PlainConsole(_PipedConsole):
    """Draws tables and bars of characters that every terminal has."""

    @property
    def encoding(self) -> str:
        """What rich takes its frames and bars for."""
        return "ascii"


def output_console(*, stderr: bool = False) -> Console:
    """The console of a standard stream: lines as wide as the terminal, or COLUMNS.

    Whole lines in a pipe or file, where words and paths are to be found and copied.  Plain
    characters where TERM is dumb.
    """
    kind = _PlainConsole if os.environ.get("TERM") == "dumb" else _PipedConsole
    made = kind(stderr=stderr)
    if not made.is_terminal and "COLUMNS" not in os.environ:
        made.width = UNBOUNDED
    return made


def titled_table(title: str, **look: Any) -> Table:
    """A table without columns and rows, its title as all tables have it."""
    return Table(title=cell(title), title_justify="left", title_style="bold", **look)


def facts_table(title: str, facts: Mapping[str, str]) -> Table:
    """Two columns: what, and what it is."""
    table = titled_table(title, show_header=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts.items():
        table.add_row(cell(name), cell(value))
    return table


def results_table(title: str, rows: Sequence[TableRow]) -> Table:
    """Measured values with their limits."""
    table = titled_table(title)
    for heading in RESULT_HEADINGS:
        table.add_column(heading)
    colours = {None: "", True: "green", False: "bold red"}
    for row in rows:
        *texts, mark = map(cell, row.texts)
        mark.stylize(colours[row.passed])
        table.add_row(*texts, mark)
    return table


def cell(text: str) -> Text:
    """A text as it is: names may hold brackets, which are no markup, and escape sequences."""
    return Text(printable(text))


def print_line(console: Console, text: str, style: str = "") -> None:
    """A line as it is, however long."""
    # Paths may hold brackets, and are to be copied whole.
    console.print(printable(text), style=style, markup=False, highlight=False, soft_wrap=True)


def print_findings(
    findings: Iterable[Finding], about: str = "", console: Console | None = None
) -> None:
    """A line for each, on stderr by default, the worst first, and what to do about it."""
    console = console or output_console(stderr=True)
    for item in sorted(findings, key=lambda item: -item.severity):
        if item.text:
            parts = (item.severity.name.lower(), about or item.about, item.text)
            print_line(console, ": ".join(filter(None, parts)), STYLES[item.severity])
        if item.advice:
            print_line(console, f"  what to do: {item.advice}")


def error_reason(error: BaseException, hint: str = "") -> str:
    """What a user reads of an error behind "error: ", mostly one line.

    hint: appended where the error is not one that a user is expected to cause.
    """
    if isinstance(error, CmpTactileError):
        return error_text(error)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return printable(f"{where}{error.strerror or error}")
    return printable(f"{type(error).__name__}: {error}{hint}")


def stage_bars(progress: Progress, **fields: Any) -> OnProgress:
    """A bar for each thing that is done, in the order in which they begin.

    Where no bar can move (a pipe, a file), a line as each begins: bars are drawn at the end there.
    fields: that the columns of the progress need.
    """
    tasks: dict[str, Any] = {}

    def on_stage(what: str, share: float) -> None:
        if what not in tasks:
            tasks[what] = progress.add_task(what, total=100, **fields)
            if not progress.console.is_terminal:
                print_line(progress.console, f"{what} ...")
        progress.update(tasks[what], completed=round(100 * share))

    return on_stage


@contextmanager
def shown_stages() -> Iterator[OnProgress]:
    """Bars on stderr with the time that each stage took; none before a stage begins."""
    with _bars() as progress:
        yield stage_bars(progress)


def _bars() -> Progress:
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=output_console(stderr=True))


def machine_facts() -> dict[str, str]:
    """Versions of the suite and its libraries, and the processor; without ROS."""
    suite = ", ".join(f"{name} {installed_version(name)}" for name in PACKAGES)
    libraries = ", ".join(f"{name} {_first_version(names)}" for name, names in LIBRARIES.items())
    return {
        "Suite": suite,
        "Python": platform.python_version(),
        "Libraries": libraries,
        "Machine": f"{processor_name()}, {_usable_cores()} cores, {_memory_gb():.0f} GB",
        "System": f"{_distribution()}, Linux {platform.release()}, {platform.machine()}",
    }


def ros_facts() -> dict[str, str]:
    """Which ROS 2 and which middleware, or that there is none."""
    try:
        from rclpy.utilities import get_rmw_implementation_identifier

        middleware = get_rmw_implementation_identifier()
    except ImportError:
        return {"ROS 2": "not found (rclpy cannot be imported)"}
    distribution = os.environ.get("ROS_DISTRO", "from the Python package registry")
    wheels = _first_version(("rclpy", "ros-rclpy"))
    return {"ROS 2": f"{distribution}, rclpy {wheels}, {middleware}"}


def installed_version(name: str, otherwise: str = "from its source folder") -> str:
    """Version of a package of Python; otherwise: for one that is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return otherwise


def _first_version(names: tuple[str, ...]) -> str:
    installed = (installed_version(name, "") for name in names)
    return next((text for text in installed if text), "not found")


def processor_name() -> str:
    """Type of this machine's processor."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def _usable_cores() -> int:
    return len(os.sched_getaffinity(0))


def _memory_gb() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9


def _distribution() -> str:
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except OSError:
        return platform.system()
