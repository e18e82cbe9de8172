"""`cmp_tactile process`: recordings through the whole chain, offline, into files."""

from __future__ import annotations

import argparse
import traceback
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cmp_tactile_bringup.commands.argument_types import number_between
from cmp_tactile_bringup.commands.error_line import error_line
from cmp_tactile_processing.errors import CmpTactileError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from cmp_tactile_bringup.offline import Job, Outcome, RecordingProcessor

__all__ = ["add_parser", "run"]


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "process",
        parents=[common],
        help="process recordings without ROS",
        description="Process every frame of each recording and write NAME.npz (all arrays) and "
        "NAME_wrench.csv (force and moment over time). Needs no running ROS.",
    )
    parser.add_argument(
        "inputs",
        nargs="+",
        type=Path,
        metavar="INPUT",
        help="a ROS 2 bag, a folder of images, one image, or a packaged scene, such as grasp",
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="where to write")
    parser.add_argument(
        "--sensor",
        help="file of a sensor description or name of a packaged one; simulated recordings know "
        "their own",
    )
    parser.add_argument("--topic", default="", help="image topic of a bag that has several")
    parser.add_argument(
        "--frame-rate",
        type=number_between(0.01, 1000, "Hz"),
        default=30.0,
        metavar="HZ",
        help="of a folder of images, which has no stamps (default: %(default)g)",
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace results that are there already"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Process all inputs; returns 1 where one, or frames of one, could not be used."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
    )

    from cmp_tactile_bringup.offline import plan_jobs

    jobs = plan_jobs(arguments.inputs, arguments.output, overwrite=arguments.overwrite)
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), console=console) as progress:
        batch = _Batch(arguments, progress)
        results = [batch.run(job) for job in jobs]
    complete = [_tell(console, job, result) for job, result in zip(jobs, results, strict=True)]
    return int(not all(complete))


class _Batch:
    """Runs jobs one after another; recordings of one sensor share its model."""

    def __init__(self, arguments: argparse.Namespace, progress: Progress) -> None:
        self._arguments = arguments
        self._progress = progress
        self._processors: dict[str, RecordingProcessor] = {}

    def run(self, job: Job) -> Outcome | Exception:
        """What came of the job, or the error that ended it."""
        from rich.markup import escape

        from cmp_tactile_bringup.offline import choose_sensor
        from cmp_tactile_bringup.recording import recorded_source
        from cmp_tactile_bringup.stages import stage_teller

        try:
            sensor = choose_sensor(job, self._arguments.sensor)
            job = replace(job, source=recorded_source(job.source, stage_teller(self._progress)))
            processor = self._processor(sensor)
            task = self._progress.add_task(escape(job.source.name), total=processor.count(job))
            return processor.process(job, lambda: self._progress.advance(task))
        except (CmpTactileError, OSError) as error:
            if self._arguments.debug:
                traceback.print_exc()
            return error

    def _processor(self, sensor: str) -> RecordingProcessor:
        from cmp_tactile_bringup.offline import FrameFolderOptions, RecordingProcessor

        if sensor not in self._processors:
            options = FrameFolderOptions(self._arguments.topic, self._arguments.frame_rate)
            task = self._progress.add_task(
                "Preparing tracker and force model (compiled once per version)",
                total=None,
            )
            try:
                self._processors[sensor] = RecordingProcessor(sensor, options)
            finally:
                self._progress.remove_task(task)
        return self._processors[sensor]


def _tell(console: Console, job: Job, result: Outcome | Exception) -> bool:
    """Print what came of a job; whether all of it could be used."""

    def tell(text: str, style: str = "") -> None:
        # Paths may hold brackets, and are to be copied whole.
        console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)

    if isinstance(result, Exception):
        tell(error_line(result), "red")
        return False
    tell(f"{job.label}: {result.frames} frames -> {job.arrays}")
    for doubt in result.doubts:
        tell(f"warning: {job.label}: {doubt}", "yellow")
    if result.problem:
        tell(f"{job.label}: not all of it could be used: {result.problem}", "red")
    return not result.problem
