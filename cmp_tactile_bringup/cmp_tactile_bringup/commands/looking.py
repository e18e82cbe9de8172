"""What `init` and `focus` look at: a camera, a recording, or a simulated sensor."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from cmp_tactile_bringup.commands.options import Choice, Command, Number, Pair, misuse, option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Images = Generator[NDArray[np.uint8] | None, None, None]

T = TypeVar("T")

PITCH = Number(0.01, 50, "mm")
# Of the print of sample_rig, mm.
USUAL_PITCH = 0.6905
# As in calibration/proposal.py, which takes long to load.
LAYOUTS = ("one", "mirrors", "cameras")
DEVICES, POLL_S = "/dev/", 0.1
FRAME_SIZE = Pair("a size in px, as 1280x720", low=16)


@dataclass(frozen=True, kw_only=True)
class Looking(Command):
    """Options of a command that looks at checkers."""

    pitch: Annotated[
        float | None,
        option("side of a checker; if not given, you are asked", PITCH),
    ] = None
    views: Annotated[
        str | None,
        option(
            "views in a frame: one, two in mirrors, or two cameras side by side (default: what "
            "is detected)",
            Choice(LAYOUTS),
        ),
    ] = None
    size: Annotated[
        str, option("size of a camera's frames", FRAME_SIZE.parse, metavar="WIDTHxHEIGHT")
    ] = "640x480"
    yes: Annotated[bool, option("ask nothing; use the proposed values")] = False

    @property
    def asks(self) -> bool:
        """Whether somebody is there to be asked."""
        return not self.yes and sys.stdin is not None and sys.stdin.isatty()

    def ask(self, question: str, default: T, parse: Callable[[str], T]) -> T:
        """The answer, or the default where nobody is there."""
        if not self.asks:
            return default
        try:
            answer: T = typer.prompt(question, default=default, value_proc=parse, err=True)
        except typer.Abort:  # the end of the input, or Ctrl-C
            raise KeyboardInterrupt from None
        return answer

    def pitch_m(self) -> float:
        """Side of a checker, m; ends where it is not given and nobody can be asked."""
        if self.pitch is None and not self.asks:
            misuse("--pitch: found nothing, expected the side of a checker, mm")
        return (self.pitch or self.ask("Side of a checker, mm", USUAL_PITCH, PITCH.parse)) / 1e3

    def frames(self, name: str) -> Images:
        """Grey frames (H, W): of a camera the newest, None where none came in POLL_S; else all.

        name: a camera of /dev, or two with a comma between; a scene; or a recording.  Raises
        FrameSourceError where there is none, and where a camera is away.
        """
        from cmp_tactile_bringup.recordings.library import is_packaged
        from cmp_tactile_driver.bags.recording import open_recording
        from cmp_tactile_processing.geometry.split import to_grey

        if name.startswith(DEVICES):
            images: Images = self._of_camera(name)
        elif is_packaged(Path(name)):
            images = _of_scene(name)
        else:
            recording = open_recording(Path(name).expanduser())
            images = (frame.image for frame in recording.frames())
        with closing(images):
            for image in images:
                yield image if image is None else to_grey(image)

    def _of_camera(self, name: str) -> Images:
        from cmp_tactile_driver.errors import FrameSourceError
        from cmp_tactile_driver.sources.frames import SourceOptions
        from cmp_tactile_driver.sources.parameters import CameraParameters
        from cmp_tactile_driver.v4l2.pair import VIEWS, open_cameras
        from cmp_tactile_processing.sensor import parts
        from cmp_tactile_processing.sensor.description import load_sensor

        width, height = map(int, self.size.split("x"))
        image = parts.ImageSize(width * (1 + name.count(",")), height)
        rois = (parts.Roi(k * width, 0, width, height) for k in range(len(VIEWS)))
        views = dict(zip(VIEWS, map(parts.ViewDescription, rois), strict=True))
        sensor = replace(load_sensor("sample_rig"), image=image, views=views)
        source = open_cameras(SourceOptions("", sensor, camera=CameraParameters(device=name)))
        try:
            source.start()
            while True:
                frame = source.poll(POLL_S)
                while frame is not None and (newer := source.poll(0.0)) is not None:
                    frame = newer
                if source.health.silent:
                    raise FrameSourceError(source.health.problem)
                yield None if frame is None else frame.image
        finally:
            source.close()


def _of_scene(name: str) -> Images:
    from cmp_tactile_simulation.live.source import SimulatedSource
    from cmp_tactile_simulation.scenes.file import load_scene

    source = SimulatedSource(load_scene(name))
    try:
        while True:
            yield source.read().image
    finally:
        source.close()
