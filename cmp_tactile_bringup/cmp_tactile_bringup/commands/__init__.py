"""The subcommands of `cmp_tactile`.

In: the words of a command line.
Out: an instance of the subcommand's class, with a method `run`; its module is loaded when needed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

import typer
from typer.core import TyperGroup

from cmp_tactile_bringup.commands.options import Command, UsageError, add_subcommand, misuse

if TYPE_CHECKING:
    from typer import Typer

__all__ = ["parse"]

PROGRAM = "cmp_tactile"
# Where each class is, and a line of help.
SUBCOMMANDS = {
    "demo": ("demo.Demo", "simulate a grasp, play it through the nodes and show the errors"),
    "live": ("graphs.Live", "simulate a sensor in real time and press it by hand"),
    "sensor": ("graphs.Sensor", "run a sensor with a camera"),
    "gripper": ("graphs.Gripper", "run the sensors of two fingers"),
    "simulate": ("simulate.Simulate", "simulate a scene: frames with truth"),
    "dataset": ("dataset.Dataset", "simulate many presses with truth, for learning"),
    "grasp": ("grasp.Grasp", "grasp an object with two sensors in MuJoCo"),
    "process": ("process.Process", "process recordings without ROS"),
    "export": ("export.Export", "write datasets and bags for training: LeRobot"),
    "zero": ("running.Zero", "set displacement and force of a running sensor to zero"),
    "call": ("running.Call", "call a service of a running node, such as a replay's pause"),
    "topics": ("running.Topics", "list the topics of running nodes"),
    "echo": ("running.Echo", "print the messages of a topic"),
    "record": ("running.Record", "record a running sensor"),
    "replay": ("graphs.Replay", "play a recording into the nodes, for RViz and your own nodes"),
    "view": ("view.View", "show a recording in a browser"),
    "focus": ("camera.Focus", "show live how sharp and well lit a camera's picture is"),
    "init": ("camera.Init", "describe a new sensor from one picture of its pattern"),
    "pattern": ("description.Pattern", "write a sensor's pattern to print: SVG, PDF, DXF"),
    "schema": ("description.Schema", "print the JSON schema of a sensor's or scene's file"),
    "info": ("description.Info", "show a sensor description and the installation"),
}
IMPORTS = {
    "tac3d": ("process.Tac3d", "recordings of a Tac3D sensor, with its forces for comparison"),
    "markers": ("process.Markers", "a file with marker positions from any tracker"),
}
CALIBRATIONS = {
    "board": ("optics.Board", "camera and mirrors from images of a board"),
    "gel": ("optics.Gel", "mirrors and gel from frames of the gel at rest"),
    "force": ("material.Force", "the gel's material from weights or a reference force sensor"),
    "relaxation": ("material.Relaxation", "how the gel relaxes while a load is held"),
    "check": ("optics.Check", "check whether a description still fits a recording"),
    "practice": ("optics.Practice", "simulated images to practise on, without a sensor"),
}
EXIT_CODES = {
    0: "done",
    1: "an error that you can correct: a wrong file, a limit that was missed",
    2: "a wrong option",
    129: "stopped as the terminal or ssh was closed",
    130: "stopped by Ctrl-C",
    143: "stopped by SIGTERM",
}
HELP = """\
Vision-based tactile sensors with a continuous marker pattern.

\b
exit codes:
{}
focus, live, sensor, gripper, record and replay run until you stop them; then
the exit code is 0.
""".format("\n".join(f"  {code:<5}{meaning}" for code, meaning in EXIT_CODES.items()))
CALIBRATE_HELP = """\
Calibrate the camera, mirrors and gel of a sensor, and the stiffness of the gel.

\b
docs/calibrate.md explains all steps; docs/tutorials/calibrate.md and
docs/tutorials/weigh.md show them on a simulated sensor.
"""


IMPORT_HELP = "Import recordings from other sensors and programs."


def parse(words: Sequence[str]) -> Command:
    """The subcommand of a command line, without the program's name.

    Raises SystemExit: 0 after a help text or a completion, 2 after a wrong option.
    """
    command = typer.main.get_command(_app(words))
    try:
        given = list(words) or ["--help"]
        made = command.main(args=given, prog_name=PROGRAM, standalone_mode=False)
    except UsageError as error:
        misuse(_message(error))
    except SystemExit as ended:
        # So rich ends where the reader of a help text has gone, as `| head` does.
        sys.exit(0 if ended.code == 1 else ended.code)
    if isinstance(made, Command):
        return made
    # The exit code after a help text.
    sys.exit(made)


class _Group(TyperGroup):
    """Subcommands; asks what a misspelt one is to be."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """As click has it, but for the message."""
        if args[0] not in self.commands and not ctx.resilient_parsing:
            from cmp_tactile_processing.sensor.yaml_file import did_you_mean

            msg = f"found {args[0]!r}, expected one of {', '.join(self.commands)}"
            raise typer.BadParameter(msg + did_you_mean(args[0], self.commands))
        return super().resolve_command(ctx, args)


def _app(words: Sequence[str]) -> Typer:
    """All subcommands; only those that are named with their options."""
    completing = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS") or ""
    named = {*words, *completing.split()}
    # Options of a group that are not given take time all the same.
    own, own_group = _begins_with_option(words), _begins_with_option(words[1:])
    app = typer.Typer(cls=_Group, help=HELP, add_completion=own, add_help_option=own)
    calibrate = typer.Typer(cls=_Group, help=CALIBRATE_HELP, add_help_option=own_group)
    short_help = "calibrate a sensor, or check its calibration"
    app.add_typer(calibrate, name="calibrate", short_help=short_help)
    imports = typer.Typer(cls=_Group, help=IMPORT_HELP, add_help_option=own_group)
    app.add_typer(imports, name="import", short_help="import recordings of other sensors")
    if own:
        app.callback()(_program)
    for group, room, subcommands in (
        (app, "", SUBCOMMANDS),
        (imports, "", IMPORTS),
        (calibrate, ".calibrate", CALIBRATIONS),
    ):
        for name, (place, summary) in subcommands.items():
            if name in named:
                module, _, made = place.partition(".")
                loaded = import_module(f"{__name__}{room}.{module}")
                add_subcommand(group, name, summary, cast("type[Command]", getattr(loaded, made)))
            else:
                group.command(name, help=summary)(_not_named)
    return app


def _begins_with_option(words: Sequence[str]) -> bool:
    return not words or words[0].startswith("-")


def _not_named() -> None:
    """Stands for a subcommand that the command line does not name."""


def _show_version(given: bool) -> None:
    if not given:
        return
    from cmp_tactile_bringup.terminal import installed_version

    print(f"{PROGRAM} {installed_version('cmp_tactile_bringup')}")
    raise typer.Exit


def _program(
    # Not as an annotation, which versions of typer before 0.12 do not read from a text.
    version: bool = typer.Option(
        False, "--version", callback=_show_version, is_eager=True, help="show the version"
    ),
) -> None:
    """Take the option of the program; typer calls `_show_version`."""


def _message(error: Any) -> str:
    """The option, and what is wrong with it."""
    if isinstance(error, typer.BadParameter) and error.message:
        parameter: Any = error.param
        if parameter is None:
            return error.message
        is_option = parameter.param_type_name == "option"
        name = max(parameter.opts, key=len) if is_option else parameter.metavar
        return f"{name}: {error.message}"
    text = str(error.format_message())
    return text[:1].lower() + text[1:]
