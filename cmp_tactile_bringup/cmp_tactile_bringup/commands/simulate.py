"""`cmp_tactile simulate`: a scene into a recording with truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cmp_tactile_bringup.commands.argument_types import whole_between
from cmp_tactile_processing.errors import printable

if TYPE_CHECKING:
    from cmp_tactile_simulation.recording.run import RunResult
    from cmp_tactile_simulation.scenes.description import Scene

__all__ = ["add_parser", "run"]

MAX_SEED = 2**32 - 1
MAX_FRAMES = 100_000


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "simulate",
        parents=[common],
        help="simulate a scene: frames with truth",
        description="Simulate a scene: contact of an indenter with the gel, what the camera sees "
        "of it, and what is true of it. An interrupted run leaves a readable recording, and the "
        "same command goes on where it stopped. docs/scenes.md tells how scenes are written.",
    )
    parser.add_argument(
        "scene",
        nargs="?",
        metavar="SCENE",
        help="packaged scene or file of a scene; NAME:VARIANT where it has variants",
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="folder to write (default: the scene's name)"
    )
    parser.add_argument(
        "--format",
        choices=("bag", "png"),
        default="bag",
        help="bag: a ROS 2 bag (MCAP) with truth topics; png: PNG with NPZ files "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--video", action="store_true", help="draw video.mp4, frames with the truth beside them"
    )
    parser.add_argument(
        "--seed",
        type=whole_between(0, MAX_SEED),
        help="of noise and print defects, not the scene's",
    )
    parser.add_argument(
        "--frames", type=whole_between(1, MAX_FRAMES), metavar="N", help="only the first N frames"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace an earlier output, finished or not"
    )
    parser.add_argument("--list", action="store_true", help="show the packaged scenes and end")
    parser.set_defaults(run=run, wrong_usage=parser.error)


def run(arguments: argparse.Namespace) -> int:
    """Simulate the scene, or list the packaged ones."""
    from cmp_tactile_simulation.scenes.library import load_scene

    if arguments.list:
        _list_scenes()
        return 0
    if arguments.scene is None:
        arguments.wrong_usage("SCENE is required; --list shows the packaged ones")
    scene = load_scene(arguments.scene)
    if arguments.seed is not None:
        from dataclasses import replace

        scene = replace(scene, seed=arguments.seed)
    output = arguments.output or Path(scene.name)
    result = _simulate(scene, output.expanduser(), arguments)
    before = f", {result.resumed} of them from an earlier run" if result.resumed else ""
    print(printable(f"{result.frames} frames -> {output}{before}"))
    return 0


def _simulate(scene: Scene, output: Path, arguments: argparse.Namespace) -> RunResult:
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from cmp_tactile_bringup.terminal.stages import stage_teller
    from cmp_tactile_bringup.terminal.tables import output_console
    from cmp_tactile_simulation.recording.run import RunOptions, run_scene

    options = RunOptions(
        format=arguments.format,
        video=arguments.video,
        frames=arguments.frames,
        overwrite=arguments.overwrite,
    )
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=output_console(stderr=True)) as progress:
        return run_scene(scene, output, options, progress=stage_teller(progress))


def _list_scenes() -> None:
    from rich.table import Table

    from cmp_tactile_bringup.terminal.tables import cell, output_console
    from cmp_tactile_simulation.scenes.library import load_scene, packaged_scene_names

    scenes = {name: load_scene(name) for name in packaged_scene_names()}
    rows = [(name, scene.source, scene.title) for name, scene in scenes.items()]
    console = output_console()
    if not console.is_terminal:
        # One line each, however long, for other programs.
        print("\n".join("\t".join(map(printable, row)) for row in rows))
        return
    table = Table("scene", "source", "title", box=None, pad_edge=False)
    for row in rows:
        table.add_row(*map(cell, row))
    console.print(table)
