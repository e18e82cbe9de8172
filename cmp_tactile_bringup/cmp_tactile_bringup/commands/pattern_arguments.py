"""Options of `cmp_tactile pattern`."""

from __future__ import annotations

import argparse
from argparse import ArgumentTypeError
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.commands.argument_types import number_between, whole_between

__all__ = ["add_pattern_arguments"]

# As the modules that do the work have them, which are loaded when it begins.
FEWEST_CORNERS, MOST_CORNERS = 4, 60
FORMATS = ("svg", "pdf", "dxf")
TYPES = ("cmp", "dmp")
PROCESSES = ("along_axis", "unrolled")
PAPERS = ("A4", "letter", "fit")
DOT_DIAMETER = 0.5
MOST_COPIES = 1000


def add_pattern_arguments(parser: argparse.ArgumentParser) -> None:
    """Add them, in groups."""
    parser.add_argument(
        "sensor",
        metavar="SENSOR",
        help="file of a sensor description or name of a packaged one",
    )
    _add_pattern(parser.add_argument_group("pattern, where it is not to be the description's"))
    _add_print(parser.add_argument_group("print"))
    _add_sheet(parser.add_argument_group("sheet and files"))


def _add_pattern(group: Any) -> None:
    corners = whole_between(FEWEST_CORNERS, MOST_CORNERS)
    group.add_argument("--rows", type=corners, metavar="N", help="inner corners along y")
    group.add_argument("--cols", type=corners, metavar="N", help="inner corners along x")
    group.add_argument(
        "--pitch",
        type=number_between(0.01, 100, "mm"),
        metavar="MM",
        help="distance of neighbouring corners in x and y, mm",
    )
    group.add_argument(
        "--corner-checker",
        choices=("dark", "light"),
        help="checker outside corner (0, 0)",
    )
    group.add_argument(
        "--advised",
        action="store_true",
        help="rows, cols, pitch and virtual markers that are advised for this camera",
    )


def _add_print(group: Any) -> None:
    group.add_argument(
        "--type",
        choices=TYPES,
        default="cmp",
        help="checkers, or dots at the places of the corners (default: %(default)s)",
    )
    group.add_argument(
        "--dot-diameter",
        type=number_between(0.01, 0.99),
        metavar="SHARE",
        help=f"of a dot, as a share of the pitch; with --type dmp (default: {DOT_DIAMETER:g})",
    )
    group.add_argument(
        "--process",
        choices=PROCESSES,
        help="along_axis: the print comes along the gel's z axis (pad or transfer printing, "
        "exposure). unrolled: a film is printed flat and laid around the gel (default: unrolled "
        "for a cylinder, along_axis otherwise, because a film on a sphere wrinkles)",
    )
    group.add_argument(
        "--mirror",
        action="store_true",
        help="for a print whose printed side goes onto the gel, as that of a transfer film",
    )
    group.add_argument(
        "--invert",
        action="store_true",
        help="ink is the light part, with the margin: for light ink on a dark skin, or where "
        "what is drawn is taken away",
    )
    group.add_argument(
        "--ink-gain",
        type=number_between(0, 10_000, "um"),
        default=0.0,
        metavar="UM",
        help="spreading of the ink at each edge, which is taken off beforehand (default: "
        "%(default)g)",
    )
    group.add_argument(
        "--margin",
        type=number_between(0, 100, "mm"),
        default=1.0,
        metavar="MM",
        help="light skin around the checkers, on which nothing is printed (default: %(default)g)",
    )
    group.add_argument(
        "--bleed",
        type=number_between(0, 100, "mm"),
        default=0.0,
        metavar="MM",
        help="beyond the margin: inverted ink goes so much farther, marks stay so much farther "
        "away (default: %(default)g)",
    )


def _add_sheet(group: Any) -> None:
    group.add_argument(
        "--paper",
        choices=PAPERS,
        default="A4",
        help="fit: as large as needed (default: %(default)s)",
    )
    group.add_argument(
        "--copies",
        type=whole_between(1, MOST_COPIES),
        default=1,
        metavar="N",
        help="on one sheet, with cut lines (default: %(default)s)",
    )
    group.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="NAME",
        help="writes NAME.svg, NAME.pdf, NAME.dxf and NAME.yaml (default: the name of "
        "the description's file and _pattern, here)",
    )
    group.add_argument(
        "--format",
        type=_formats,
        metavar="LIST",
        help="of svg, pdf and dxf, with commas between (default: all)",
    )
    group.add_argument("--overwrite", action="store_true", help="replace files that are there")


def _formats(text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    if not set(names) <= set(FORMATS):
        msg = f"found {text!r}, expected one or more of svg, pdf and dxf, as svg,pdf"
        raise ArgumentTypeError(msg)
    return names
