"""Options of `cmp_tactile process`."""

from __future__ import annotations

import argparse
import math
import os
from argparse import ArgumentTypeError
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.commands.argument_types import number_between, whole_between

__all__ = ["add_process_arguments"]

MOST_REFERENCE_FRAMES = 1000
MOST_JOBS = 256
# What a process needs, twice over.
BYTES_PER_JOB = 1 << 30
LONGEST_S = 1e6


def add_process_arguments(parser: argparse.ArgumentParser) -> None:
    """Add them, in groups."""
    parser.add_argument(
        "inputs",
        nargs="+",
        type=Path,
        metavar="INPUT",
        help="a ROS 2 bag, a folder of images, one image, a video, or a packaged scene, as grasp",
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="where to write")
    parser.add_argument(
        "--sensor",
        help="file of a sensor description or name of a packaged one; simulated recordings know "
        "their own",
    )
    _add_reading(parser.add_argument_group("what is read"))
    _add_results(parser.add_argument_group("results"))
    _add_work(parser.add_argument_group("work"))


def _add_reading(group: Any) -> None:
    seconds = number_between(0, LONGEST_S, "s")
    group.add_argument("--topic", default="", help="image topic of a bag that has several")
    group.add_argument(
        "--frame-rate",
        type=number_between(0.01, 1000, "Hz"),
        default=30.0,
        metavar="HZ",
        help="of a folder of images, which has no stamps (default: %(default)g)",
    )
    group.add_argument(
        "--start",
        type=seconds,
        default=0.0,
        metavar="S",
        help="begin so many seconds after the first frame (default: %(default)g)",
    )
    group.add_argument(
        "--end",
        type=seconds,
        default=math.inf,
        metavar="S",
        help="end so many seconds after the first frame (default: with the recording)",
    )


def _add_results(group: Any) -> None:
    group.add_argument(
        "--reference",
        type=_reference,
        default="nominal",
        metavar="WHAT",
        help="what displacement, and so force, counts from: nominal (the sensor description's "
        "surface), when_still or at_start (taken by itself, as the stereo_triangulator node does "
        "with its parameter auto_reference), first-N (mean of the first N frames, in which the gel "
        "must be at rest, as its service set_reference takes it) (default: %(default)s)",
    )
    group.add_argument(
        "--views",
        choices=("both", "left", "right", "none"),
        default="both",
        help="whose grids are written; both are processed all the same (default: %(default)s)",
    )
    group.add_argument(
        "--parquet", action="store_true", help="write NAME_wrench.parquet, too (needs pyarrow)"
    )
    group.add_argument("--arrays", action="store_true", help="write NAME.npz, too")
    group.add_argument(
        "--overwrite",
        action="store_true",
        help="replace results that are there already and were made from something else",
    )


def _add_work(group: Any) -> None:
    where = group.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs",
        type=whole_between(1, MOST_JOBS),
        default=_default_jobs(),
        metavar="N",
        help="recordings that are processed at once, each in a process of its own (default: half "
        "the cores, here %(default)d)",
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="of a running dask cluster that is to do the work, as tcp://host:8786; its machines "
        "must see the same files (needs dask.distributed)",
    )


def _default_jobs() -> int:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return max(1, min(len(os.sched_getaffinity(0)) // 2, memory // BYTES_PER_JOB, MOST_JOBS))


def _reference(text: str) -> str:
    kind, _, number = text.partition("-")
    if text in ("nominal", "when_still", "at_start"):
        return text
    if kind == "first" and number.isdecimal() and 1 <= int(number) <= MOST_REFERENCE_FRAMES:
        return f"first-{int(number)}"
    msg = (
        f"found {text!r}, expected nominal, when_still, at_start, or first-N with N from 1 to "
        f"{MOST_REFERENCE_FRAMES}"
    )
    raise ArgumentTypeError(msg)
