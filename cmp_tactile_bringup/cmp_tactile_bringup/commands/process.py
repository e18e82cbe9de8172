"""`cmp_tactile process`: recordings through the whole chain, offline, into files."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.commands.argument_types import number_between

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
        help="a ROS 2 bag, a folder of images, or one image",
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="where to write")
    parser.add_argument(
        "--sensor",
        default="prototype",
        help="file of a sensor description or name of a packaged one (default: %(default)s)",
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
    """Process all inputs; returns 1 where frames of one could not be used."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
    )

    from cmp_tactile_bringup.offline import FrameFolderOptions, RecordingProcessor, plan_jobs

    options = FrameFolderOptions(arguments.topic, arguments.frame_rate)
    jobs = plan_jobs(arguments.inputs, arguments.output, overwrite=arguments.overwrite)
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), console=console) as progress:
        task = progress.add_task("Preparing the force model", total=None)
        processor = RecordingProcessor(arguments.sensor, options)
        progress.remove_task(task)
        results = []
        for job in jobs:
            task = progress.add_task(job.source.name, total=processor.count(job))
            advance = lambda task=task: progress.advance(task)  # noqa: E731
            results.append(processor.process(job, advance))
    damaged = False
    for job, result in zip(jobs, results, strict=True):
        console.print(f"{job.source}: {result.frames} frames -> {job.arrays}")
        if result.problem:
            damaged = True
            console.print(f"[red]{job.source}: not all of it could be used: {result.problem}[/]")
    return int(damaged)
