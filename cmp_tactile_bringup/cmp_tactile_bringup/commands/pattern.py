"""`cmp_tactile pattern`: the pattern of a sensor as files to print, to scale."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cmp_tactile_bringup.commands.pattern_arguments import DOT_DIAMETER, add_pattern_arguments
from cmp_tactile_processing.errors import printable

if TYPE_CHECKING:
    from cmp_tactile_processing.printing.pattern import PrintedPattern
    from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Write the pattern of a sensor to scale, as SVG, PDF and DXF, with registration marks, the gel's
outline and scale bars, and the sensor description that agrees with it. docs/tutorials/print.md
tells how to print and mount it.
"""
EPILOG = """\
which way round:
  The sheet shows the print as it is seen from the touching side: x to the right, y up, corner
  (0, 0) at the bottom left. So it is right where the printed side looks away from the gel. Where
  the printed side goes onto the gel, as that of a transfer film does, give --mirror: the sheet then
  shows it as the camera's side sees it, x to the right, y down, corner (0, 0) at the top left.

examples:
  cmp_tactile pattern my_sensor.yaml
  cmp_tactile pattern my_sensor.yaml --advised --copies 12 --mirror -o advised
  cmp_tactile pattern my_sensor.yaml --rows 24 --cols 24 --pitch 0.55 --ink-gain 15 --format pdf
"""


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "pattern",
        parents=[common],
        help="write a sensor's pattern to print: SVG, PDF, DXF",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_pattern_arguments(parser)
    parser.set_defaults(run=run, wrong_usage=parser.error)


def run(arguments: argparse.Namespace) -> int:
    """Write the files and tell what is on them."""
    from cmp_tactile_bringup.printing.facts import pattern_warnings, print_facts, seen_facts
    from cmp_tactile_bringup.printing.files import FORMATS, PatternFiles
    from cmp_tactile_processing.printing.sheet import print_sheet, printed_copy
    from cmp_tactile_processing.sensor.library import find_sensor_description

    if arguments.dot_diameter is not None and arguments.type != "dmp":
        arguments.wrong_usage("--dot-diameter goes with --type dmp")
    source = find_sensor_description(arguments.sensor)
    sensor = _sensor(source, arguments)
    output = arguments.output or Path(f"{source.stem}_pattern")
    files = PatternFiles.from_output(output, arguments.format or FORMATS)
    files.check_free(source, overwrite=arguments.overwrite)
    printed = _printed(sensor, arguments)
    copy = printed_copy(sensor.name, printed, mirrored=arguments.mirror)
    sheet = print_sheet(copy, arguments.paper, arguments.copies)
    written, missing = files.write(sheet, sensor)
    _show("Print", print_facts(printed, copy, sheet))
    _show("What the camera will see", seen_facts(sensor, arguments.type))
    for warning in (*pattern_warnings(sensor, printed), *missing):
        print(printable(f"warning: {warning}"), file=sys.stderr)
    for path in written:
        print(printable(f"Written: {path}"))
    # What was asked for by name and is not there is a failure.
    return 1 if missing and (arguments.format or not written) else 0


def _sensor(source: Path, arguments: argparse.Namespace) -> SensorDescription:
    """The sensor with the pattern that is asked for, checked as if it were read."""
    from dataclasses import replace

    from cmp_tactile_processing.errors import DescriptionError
    from cmp_tactile_processing.sensor.description import (
        SensorDescription,
        sensor_description_of,
        sensor_description_text,
    )
    from cmp_tactile_processing.sensor.yaml_section import parse_yaml

    options = ("rows", "cols", "pitch", "corner_checker")
    asked = {key: getattr(arguments, key) for key in options if getattr(arguments, key) is not None}
    if arguments.advised and set(asked) - {"corner_checker"}:
        arguments.wrong_usage("--advised stands in the place of --rows, --cols and --pitch")
    sensor = SensorDescription.load(source)
    changes = asked | ({"pitch": asked["pitch"] / 1e3} if "pitch" in asked else {})
    if arguments.advised:
        changes |= _advised(sensor)
    sensor = replace(sensor, pattern=replace(sensor.pattern, **changes))
    try:
        return sensor_description_of(parse_yaml(source, sensor_description_text(sensor)))
    except DescriptionError as error:
        given = [f"--{key.replace('_', '-')} {value}" for key, value in asked.items()]
        words = ["--advised", *given] if arguments.advised else given
        raise DescriptionError(f"{error} (with {' '.join(words)})") from None


def _advised(sensor: SensorDescription) -> dict[str, Any]:
    """What the advice changes of the pattern."""
    from cmp_tactile_bringup.printing.facts import advice_of

    advice = advice_of(sensor)
    names = ("rows", "cols", "pitch", "points_per_segment")
    return {name: getattr(advice, name) for name in names}


def _printed(sensor: SensorDescription, arguments: argparse.Namespace) -> PrintedPattern:
    from cmp_tactile_processing.printing.pattern import PrintOptions, printed_pattern

    options = PrintOptions(
        pattern_type=arguments.type,
        process=arguments.process or "",
        invert=arguments.invert,
        ink_gain=arguments.ink_gain / 1e6,
        margin=arguments.margin / 1e3,
        bleed=arguments.bleed / 1e3,
        dot_diameter=arguments.dot_diameter or DOT_DIAMETER,
    )
    return printed_pattern(sensor, options)


def _show(title: str, facts: dict[str, str]) -> None:

    from cmp_tactile_bringup.terminal.tables import facts_table, output_console

    output_console().print(facts_table(title, facts))
