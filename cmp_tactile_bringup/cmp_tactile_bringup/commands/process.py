"""`cmp_tactile process`: recordings through the whole chain, offline, into files."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from cmp_tactile_bringup.commands.process_arguments import add_process_arguments
from cmp_tactile_bringup.terminal.error_line import error_line
from cmp_tactile_processing.errors import printable

if TYPE_CHECKING:
    from rich.console import Console

    from cmp_tactile_bringup.offline.display import Display
    from cmp_tactile_bringup.offline.jobs import Job, Options, Outcome
    from cmp_tactile_bringup.offline.task import Task

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Process every frame of each recording and write NAME.mcap (grids, surface, force field and wrench as
the nodes publish them) and NAME_wrench.csv (force and moment over time). Needs no running ROS. The
same input gives the same bytes. An interrupted run goes on when the same command is given again:
finished recordings are kept as they are, others begin anew.
"""


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "process",
        parents=[common],
        help="process recordings without ROS",
        description=DESCRIPTION,
    )
    add_process_arguments(parser)
    parser.set_defaults(run=run, usage_error=parser.error)


def run(arguments: argparse.Namespace) -> int:
    """Process all inputs; returns 1 where one, or frames of one, could not be used."""
    from cmp_tactile_bringup.offline.jobs import plan_jobs
    from cmp_tactile_bringup.offline.result_tables import require_parquet
    from cmp_tactile_bringup.terminal.tables import output_console

    if arguments.end < arguments.start:
        arguments.usage_error(f"--end: found {arguments.end:g} s, expected --start or later")
    if arguments.parquet:
        require_parquet()
    jobs = plan_jobs(arguments.inputs, arguments.output)
    console = output_console(stderr=True)
    if len(jobs) < len(arguments.inputs):
        console.print("warning: recordings that are named twice are processed once", style="yellow")
    complete = _process(jobs, arguments, console)
    if len(jobs) > 1:
        console.print(f"{len(jobs)} recordings, {complete.count(True)} without a problem")
    return int(not all(complete))


def _options(arguments: argparse.Namespace) -> Options:
    from cmp_tactile_bringup.offline.jobs import Options

    return Options(
        topic=arguments.topic,
        frame_rate=arguments.frame_rate,
        reference=arguments.reference,
        views=arguments.views,
        start_s=arguments.start,
        end_s=arguments.end,
        arrays=arguments.arrays,
        parquet=arguments.parquet,
    )


def _process(jobs: list[Job], arguments: argparse.Namespace, console: Console) -> list[bool]:
    """Whether all of each recording could be used, told as soon as it has ended."""
    from cmp_tactile_bringup.offline.display import Display
    from cmp_tactile_bringup.offline.task import Task

    options, tasks, complete = _options(arguments), list[Task](), list[bool]()
    for job in jobs:
        sensor = _sensor_of(job, arguments.sensor)
        if isinstance(sensor, Exception):
            complete.append(_tell(console, job, sensor))
        else:
            tasks.append(Task(replace(job, sensor=sensor), options, arguments.overwrite))

    def tell(number: int, result: Outcome | Exception) -> None:
        complete.append(_tell(console, tasks[number].job, result))

    with Display([task.job.name for task in tasks], console, tell) as display:
        _run(tasks, arguments, display)
    return complete


def _sensor_of(job: Job, given: str | None) -> str | Exception:
    from cmp_tactile_bringup.offline.jobs import sensor_of
    from cmp_tactile_processing.errors import CmpTactileError

    try:
        return sensor_of(job, given)
    except (CmpTactileError, OSError) as error:
        return error


def _run(tasks: list[Task], arguments: argparse.Namespace, display: Display) -> None:
    debug = arguments.debug
    if tasks and arguments.scheduler:
        from cmp_tactile_bringup.offline.cluster import run_on_cluster

        run_on_cluster(tasks, display, arguments.scheduler, debug=debug)
    elif min(arguments.jobs, len(tasks)) > 1:
        from cmp_tactile_bringup.offline.processes import run_in_processes

        run_in_processes(tasks, display, arguments.jobs, debug=debug)
    else:
        from cmp_tactile_bringup.offline.here import run_here

        run_here(tasks, display, debug=debug)


def _tell(console: Console, job: Job, result: Outcome | Exception) -> bool:
    """Print what came of a job; whether all of it could be used."""

    def tell(text: str, style: str = "") -> None:
        # Paths may hold brackets, and are to be copied whole.
        console.print(printable(text), style=style, markup=False, highlight=False, soft_wrap=True)

    if isinstance(result, Exception):
        line = error_line(result, "; --debug shows where").removeprefix("error: ")
        # Most errors name the file that they are about.
        tell(f"error: {line if job.label in line else f'{job.label}: {line}'}", "red")
        return False
    before = ", finished before" if result.finished_before else ""
    tell(f"{job.label}: {result.frames} frames -> {job.path('.mcap')}{before}")
    tell(f"{job.label}: displacement counts from: {result.reference}")
    for doubt in result.doubts:
        tell(f"warning: {job.label}: {doubt}", "yellow")
    if result.problem:
        tell(f"{job.label}: not all of it could be used: {result.problem}", "red")
    return not result.problem
