"""`cmp_tactile pattern` and `info`: what follows from a sensor's description."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cmp_tactile_bringup.commands.options import Choice, Command, Number, argument, misuse, option

if TYPE_CHECKING:
    from cmp_tactile_processing.printing.pattern import PrintedPattern
    from cmp_tactile_processing.sensor.description import SensorDescription

# As the modules that do the work have them, which are loaded when it begins.
FEWEST_CORNERS, MOST_CORNERS = 4, 60
FORMATS = ("svg", "pdf", "dxf")
PROCESSES = ("along_axis", "unrolled")
PAPERS = ("A4", "letter", "fit")
CODES, LARGEST_SEED = ("none", "dots"), 65535

CORNERS = Number(FEWEST_CORNERS, MOST_CORNERS, kind=int)
LENGTH = Number(0, 100, "mm")
_change = partial(option, group="Pattern (default: the description's)")
_printing = partial(option, group="Print")
_sheet = partial(option, group="Sheet and files")


def _formats(text: str) -> str:
    """Words with commas between."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    if not set(names) <= set(FORMATS):
        msg = f"found {text!r}, expected one or more of svg, pdf and dxf, separated by commas"
        raise typer.BadParameter(msg)
    return ",".join(names)


@dataclass(frozen=True, kw_only=True)
class Pattern(Command):
    """Write the pattern of a sensor to scale, as SVG, PDF and DXF, with axes, the gel's outline and
    scale bars. The matching sensor description is written, too.
    docs/print.md shows how to print and mount the pattern.

    which way round:
      The sheet shows the print as seen from the touching side: x to the right, y up, corner
      (0, 0) at the bottom left. This is right if the printed side faces away from the gel. If
      the printed side goes onto the gel, as with a transfer film, give --mirror. The sheet then
      shows the print as seen from the camera: x to the right, y down, corner (0, 0) at the top
      left.

    examples:
      cmp_tactile pattern my_sensor.yaml
      cmp_tactile pattern my_sensor.yaml --advised --mirror -o advised
      cmp_tactile pattern my_sensor.yaml --rows 24 --cols 24 --pitch 0.55 --ink-gain 15
    """

    sensor: Annotated[str, argument("SENSOR", "sensor description: a file or a packaged name")]
    rows: Annotated[int | None, _change("inner corners along y", CORNERS)] = None
    cols: Annotated[int | None, _change("inner corners along x", CORNERS)] = None
    pitch: Annotated[
        float | None,
        _change("distance of neighbouring corners in x and y, mm", Number(0.01, 100, "mm")),
    ] = None
    corner_checker: Annotated[
        str | None, _change("checker outside corner (0, 0)", Choice(("dark", "light")))
    ] = None
    code: Annotated[
        str | None,
        _change(
            "dots: a code in the checkers shows the place of each part of the pattern, and whether "
            "it is mirrored or turned (default: dots where they cost no accuracy)",
            Choice(CODES),
        ),
    ] = None
    code_seed: Annotated[
        int | None,
        _change(
            "number of the sheet; each has different dots (0)", Number(0, LARGEST_SEED, kind=int)
        ),
    ] = None
    advised: Annotated[
        bool,
        _change("use the rows, cols, pitch and virtual markers that are advised for this camera"),
    ] = False
    process: Annotated[
        str | None,
        _printing(
            "along_axis: printed along the gel's z axis (pad or transfer printing, exposure). "
            "unrolled: a film is printed flat and laid around the gel (default: unrolled for a "
            "cylinder, else along_axis, because a film on a sphere wrinkles)",
            Choice(PROCESSES),
        ),
    ] = None
    mirror: Annotated[
        bool,
        _printing("mirror the sheet: the printed side goes onto the gel, as with a transfer film"),
    ] = False
    invert: Annotated[
        bool,
        _printing(
            "print the light parts and the margin instead of the dark ones: for light ink on a "
            "dark skin, or if the drawn parts are removed"
        ),
    ] = False
    ink_gain: Annotated[
        float,
        _printing(
            "spread of the ink at each edge; the drawing is made smaller by it",
            Number(0, 10_000, "um"),
        ),
    ] = 0.0
    margin: Annotated[
        float, _printing("width of the light skin around the checkers, without print", LENGTH)
    ] = 1.0
    bleed: Annotated[
        float,
        _printing(
            "distance beyond the margin that inverted ink covers and that marks keep free", LENGTH
        ),
    ] = 0.0
    paper: Annotated[str, _sheet("size of the sheet; fit: as large as needed", Choice(PAPERS))] = (
        "A4"
    )
    output: Annotated[
        Path | None,
        _sheet(
            "write NAME.svg, NAME.pdf, NAME.dxf and NAME.yaml (default: the name of the "
            "description's file with _pattern, in this folder)",
            metavar="NAME",
            short="-o",
        ),
    ] = None
    format: Annotated[
        str | None,
        _sheet("svg, pdf and dxf, separated by commas (default: all)", _formats, metavar="LIST"),
    ] = None
    overwrite: Annotated[bool, _sheet("replace existing files")] = False

    def run(self) -> int:
        """Write the files and print what is on them."""
        from cmp_tactile_bringup.printing.facts import pattern_warnings, print_facts, seen_facts
        from cmp_tactile_bringup.printing.files import FORMATS, PatternFiles
        from cmp_tactile_bringup.terminal import print_findings
        from cmp_tactile_processing.errors import printable, warnings_of
        from cmp_tactile_processing.printing.pattern import why_no_dots
        from cmp_tactile_processing.printing.sheet import print_sheet
        from cmp_tactile_processing.sensor.description import find_sensor_description

        formats = tuple(self.format.split(",")) if self.format else None
        source = find_sensor_description(self.sensor)
        sensor = _sensor(source, self)
        output = self.output or Path(f"{source.stem}_pattern")
        files = PatternFiles.from_output(output, formats or FORMATS)
        files.check_free(source, overwrite=self.overwrite)
        printed = _printed(sensor, self)
        sheet = print_sheet(sensor.name, printed, self.paper, mirrored=self.mirror)
        written, missing = files.write(sheet, sensor)
        _show("Print", print_facts(printed, sheet))
        seen = seen_facts(sensor)
        if sensor.pattern.code == "none" and self.code is None:
            reason = why_no_dots(sensor, self.ink_gain / 1e6)
            seen["Code"] = f"none: {reason}; --code dots prints dots all the same"
        _show("What the camera will see", seen)
        print_findings(warnings_of(*pattern_warnings(sensor, printed), *missing))
        for path in written:
            print(printable(f"Written: {path}"))
        # What was asked for by name and is not there is a failure.
        return 1 if missing and (formats or not written) else 0


@dataclass(frozen=True, kw_only=True)
class Info(Command):
    """Show a sensor description, the geometry that follows from it, the packaged descriptions, and
    the installed versions.
    """

    sensor: Annotated[
        str | None,
        argument(
            "SENSOR",
            "sensor description: a file or a packaged name (default: prototype)",
        ),
    ] = None

    def run(self) -> int:
        """Print the tables."""
        from cmp_tactile_bringup.report.sensor_facts import description_facts, geometry_facts
        from cmp_tactile_bringup.terminal import (
            facts_table,
            machine_facts,
            output_console,
            ros_facts,
        )
        from cmp_tactile_processing.sensor.description import (
            DEFAULT_SENSOR,
            find_sensor_description,
            load_sensor,
            packaged_sensors,
        )

        name = self.sensor or DEFAULT_SENSOR
        sensor = load_sensor(name)
        facts = {"File": str(find_sensor_description(name)), **description_facts(sensor)}
        console = output_console()
        console.print(facts_table(f"Sensor {sensor.name}", facts))
        if sensor.views:
            console.print(facts_table("Derived geometry", geometry_facts(sensor)))
        packaged = {key: str(path) for key, path in packaged_sensors().items()}
        console.print(facts_table("Packaged sensors", packaged))
        console.print(facts_table("Installation", {**machine_facts(), **ros_facts()}))
        return 0


@dataclass(frozen=True, kw_only=True)
class Schema(Command):
    """Print the JSON schema of a file that you write: an editor then completes its keys, and marks
    what is wrong while you type.

    example, for editors with the YAML language server:
      cmp_tactile schema sensor > sensor.schema.json
      the first line of my_sensor.yaml:
      # yaml-language-server: $schema=sensor.schema.json
    """

    file: Annotated[str, argument("sensor|scene|recipe", "kind of the file")]

    def run(self) -> int:
        """Print it."""
        import json

        if self.file == "sensor":
            from cmp_tactile_processing.sensor.description import sensor_schema as schema
        elif self.file == "scene":
            from cmp_tactile_simulation.scenes.file import scene_schema as schema
        elif self.file == "recipe":
            from cmp_tactile_simulation.dataset.recipe import recipe_schema as schema
        else:
            misuse(f"found {self.file!r}, expected sensor, scene or recipe")
        print(json.dumps(schema(), indent=1))
        return 0


def _sensor(source: Path, arguments: Pattern) -> SensorDescription:
    """The sensor with the pattern that is asked for, checked as if it were read."""
    from dataclasses import replace

    from cmp_tactile_processing.errors import InputError
    from cmp_tactile_processing.printing.pattern import why_no_dots
    from cmp_tactile_processing.sensor.description import (
        SensorDescription,
        sensor_description_of,
        sensor_description_text,
    )
    from cmp_tactile_processing.sensor.yaml_file import parse_yaml

    of_the_code = "code", "code_seed"
    options = ("rows", "cols", "pitch", "corner_checker", *of_the_code)
    asked = {key: getattr(arguments, key) for key in options if getattr(arguments, key) is not None}
    if arguments.advised and set(asked) - {"corner_checker", *of_the_code}:
        misuse("--advised replaces --rows, --cols and --pitch: give one or the other")
    sensor = SensorDescription.load(source)
    changes = asked | ({"pitch": asked["pitch"] / 1e3} if "pitch" in asked else {})
    if asked.get("code") == "none":
        changes = {"code_seed": 0, **changes}
    if arguments.advised:
        changes |= _advised(sensor)
    sensor = replace(sensor, pattern=replace(sensor.pattern, **changes))
    if arguments.code is None and not why_no_dots(sensor, arguments.ink_gain / 1e6):
        sensor = replace(sensor, pattern=replace(sensor.pattern, code="dots"))
    try:
        return sensor_description_of(parse_yaml(source, sensor_description_text(sensor)))
    except InputError as error:
        given = [f"--{key.replace('_', '-')} {value}" for key, value in asked.items()]
        words = ["--advised", *given] if arguments.advised else given
        raise InputError(f"{error} (with {' '.join(words)})") from None


def _advised(sensor: SensorDescription) -> dict[str, Any]:
    """What the advice changes of the pattern."""
    from cmp_tactile_bringup.printing.facts import advice_of

    advice = advice_of(sensor)
    names = ("rows", "cols", "pitch", "points_per_segment")
    return {name: getattr(advice, name) for name in names}


def _printed(sensor: SensorDescription, arguments: Pattern) -> PrintedPattern:
    from cmp_tactile_processing.printing.pattern import PrintOptions, printed_pattern

    options = PrintOptions(
        process=arguments.process or "",
        invert=arguments.invert,
        ink_gain=arguments.ink_gain / 1e6,
        margin=arguments.margin / 1e3,
        bleed=arguments.bleed / 1e3,
    )
    return printed_pattern(sensor, options)


def _show(title: str, facts: dict[str, str]) -> None:
    from cmp_tactile_bringup.terminal import facts_table, output_console

    output_console().print(facts_table(title, facts))
