"""`cmp_tactile simulate`: a scene into a recording with truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cmp_tactile_bringup.commands.options import Choice, Command, Number, argument, misuse, option
from cmp_tactile_processing.cache.files import expanded_path

if TYPE_CHECKING:
    from cmp_tactile_simulation.scenes.description import Scene

MAX_SEED = 2**32 - 1
MAX_FRAMES = 100_000


@dataclass(frozen=True, kw_only=True)
class Simulate(Command):
    """Simulate a scene: the contact of an indenter with the gel, the camera frames, and the truth.
    An interrupted run leaves a readable recording; the same command starts again. docs/scenes.md
    describes the files of scenes.
    """

    scene: Annotated[
        str | None,
        argument(
            "SCENE", "packaged scene or file of a scene; NAME:VARIANT if the scene has variants"
        ),
    ] = None
    output: Annotated[
        Path | None, option("folder to write (default: the scene's name)", metavar="DIR")
    ] = None
    format: Annotated[
        str,
        option(
            "bag: a ROS 2 bag (MCAP) with truth topics; png: PNG with NPZ files",
            Choice(("bag", "png")),
        ),
    ] = "bag"
    video: Annotated[bool, option("write video.mp4: frames beside their truth")] = False
    seed: Annotated[
        int | None,
        option(
            "seed of noise and print defects, instead of the scene's", Number(0, MAX_SEED, kind=int)
        ),
    ] = None
    frames: Annotated[
        int | None, option("simulate only the first N frames", Number(1, MAX_FRAMES, kind=int))
    ] = None
    overwrite: Annotated[bool, option("replace a finished output")] = False
    list_: Annotated[bool, option("show the packaged scenes and end")] = False

    def run(self) -> int:
        """Simulate the scene, or list the packaged ones."""
        from cmp_tactile_processing.errors import printable
        from cmp_tactile_simulation.scenes.file import load_scene

        if self.list_:
            _list_scenes()
            return 0
        if self.scene is None:
            misuse("SCENE is required; --list shows the packaged ones")
        scene = load_scene(self.scene)
        if self.seed is not None:
            scene = replace(scene, seed=self.seed)
        output = self.output or Path(scene.name)
        frames = _simulate(scene, expanded_path(output), self)
        print(printable(f"{frames} frames -> {output}"))
        return 0


def _simulate(scene: Scene, output: Path, arguments: Simulate) -> int:
    from cmp_tactile_bringup.terminal import shown_stages
    from cmp_tactile_simulation.recording.run import RunOptions, run_scene

    options = RunOptions(
        format=arguments.format,
        video=arguments.video,
        frames=arguments.frames,
        overwrite=arguments.overwrite,
    )
    with shown_stages() as on_stage:
        return run_scene(scene, output, options, progress=on_stage)


def _list_scenes() -> None:
    from rich.table import Table

    from cmp_tactile_bringup.terminal import cell, output_console
    from cmp_tactile_processing.errors import printable
    from cmp_tactile_simulation.scenes.file import load_scene, packaged_scene_names

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
