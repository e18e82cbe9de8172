"""`cmp_tactile focus` and `init`: a camera's picture of checkers.

They look at a camera, a recording, or a simulated sensor.
"""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from cmp_tactile_bringup.commands.description import LARGEST_SEED
from cmp_tactile_bringup.commands.options import (
    Choice,
    Command,
    Number,
    Pair,
    argument,
    misuse,
    option,
)
from cmp_tactile_processing.cache.files import expanded_path

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import RenderableType

    from cmp_tactile_processing.calibration.counting import MarkerQuality
    from cmp_tactile_processing.calibration.proposal import Proposal
    from cmp_tactile_processing.sensor.description import SensorDescription

    Images = Generator[NDArray[np.uint8] | None, None, None]

T = TypeVar("T")
PITCH = Number(0.01, 50, "mm")
# Of the print of sample_rig, mm.
USUAL_PITCH = 0.6905
# As in calibration/proposal.py, which takes long to load.
LAYOUTS = ("one", "mirrors", "cameras")
DEVICES, POLL_S = "/dev/", 0.1
FRAME_SIZE = Pair("a size in px, as 1280x720", low=16)
# What is worth a hint, and what is worth doing before a sensor is used, of a marker's standard
# deviation.
HINT_GAIN, LEAST_GAIN = 0.15, 0.5
# Between lines where they stay.
LINE_S = 1.0
YOUNG, THICKNESS = Number(1, 1e7, "kPa"), Number(0.5, 100, "mm")
# Keys of a description that no picture shows, and those that one view does not.
ASSUMED = "poisson:", "shading_layer:", "cx:", "cy:", "layers:"
OF_ONE_VIEW = "surface:", "distortion:", "fx:", "fy:"
# The same in the description's uncertainty, with deviations as wide as what labs use: silicones of
# 30 to 2000 kPa, gels 2 to 10 mm thick.
ASSUMED_STD = {
    "young:": ("elastomer.young", 0.5),
    "size:": ("elastomer.thickness", 0.3),
    "poisson:": ("elastomer.poisson", 0.02),
    "shading_layer:": ("elastomer.shading_layer", 0.5),
}
# Of a focal length, relative, and of a principal point, in widths of the frame.
FOCAL_STD, CENTRE_STD = 0.1, 0.02
# A camera adjusts its exposure in the first frames.
FRAMES_TO_SETTLE = 15


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
            "is detected; init asks if no dots show it)",
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
        from cmp_tactile_processing.errors import FrameSourceError
        from cmp_tactile_processing.geometry.split import to_grey

        if name.startswith(DEVICES):
            images: Images = self._of_camera(name)
        elif is_packaged(Path(name)):
            images = _of_scene(name)
        elif name.isdecimal() and not Path(name).exists():
            # As OpenCV and many other programs number cameras.
            expected = f"a camera, as /dev/video{name}, a recording or a scene"
            msg = f"{name}: found a number, expected {expected}"
            raise FrameSourceError(msg)
        else:
            recording = open_recording(expanded_path(name))
            images = (frame.image for frame in recording.frames())
        with closing(images):
            for image in images:
                yield image if image is None else to_grey(image)

    def _of_camera(self, name: str) -> Images:
        from cmp_tactile_driver.sources.frames import VIEWS, SourceOptions
        from cmp_tactile_driver.sources.parameters import CameraParameters
        from cmp_tactile_driver.v4l2.pair import open_cameras
        from cmp_tactile_processing.errors import FrameSourceError
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


@dataclass(frozen=True, kw_only=True)
class Focus(Looking):
    """Show live how good a camera's picture of the pattern is, while you set focus and light: size
    of the checkers, blur, contrast, noise, and the resulting error of a marker in um. The number
    in brackets after a value is the error that would remain if only this value were improved:
    improve the value with the smallest number first. Ctrl-C ends it.

    examples:
      cmp_tactile focus /dev/video0 --pitch 0.69
      cmp_tactile focus /dev/video0 --size 1280x720 --pitch 0.69 --views mirrors
    """

    source: Annotated[
        str,
        argument(
            "SOURCE",
            "camera, as /dev/video0 (two with a comma between). To try it without a camera: a "
            "video, an image, a folder of images, a bag, or a scene",
        ),
    ]

    def run(self) -> int:
        """Show until a signal comes, or the recording ends."""
        from rich.live import Live

        from cmp_tactile_bringup.terminal import output_console, print_line
        from cmp_tactile_processing.processes import StopSignal

        meter = _Meter(self.views or "", self.pitch_m())
        console, shown = output_console(), -LINE_S
        stop = StopSignal()
        with (
            closing(self.frames(self.source)) as frames,
            Live(console=console, auto_refresh=False) as live,
        ):
            for image in frames:
                if stop.wait(0.0):
                    break
                if image is None:
                    continue
                if console.is_terminal:
                    live.update(meter.table(image), refresh=True)
                elif time.monotonic() - shown >= LINE_S:
                    shown = time.monotonic()
                    print_line(console, meter.line(image))
                    sys.stdout.flush()
        return 0


class _Meter:
    """Figures of one picture after another, with the least blur so far."""

    def __init__(self, layout: str, pitch: float) -> None:
        self._layout, self._pitch = layout, pitch
        self._best: dict[str, float] = {}

    def table(self, image: NDArray[np.uint8]) -> RenderableType:
        """For a terminal."""
        from rich.table import Table

        rows = self._rows(image)
        if isinstance(rows, str):
            return rows
        table = Table("", *rows, caption="(um): error of a marker if only this were improved")
        for heading in next(iter(rows.values())):
            table.add_row(heading, *(cells[heading] for cells in rows.values()))
        return table

    def line(self, image: NDArray[np.uint8]) -> str:
        """For a file."""
        rows = self._rows(image)
        if isinstance(rows, str):
            return rows
        return "; ".join(
            f"{view}: " + ", ".join(f"{heading} {text}" for heading, text in cells.items())
            for view, cells in rows.items()
        )

    def _rows(self, image: NDArray[np.uint8]) -> dict[str, dict[str, str]] | str:
        """Cells by view and heading; a text where no checkers are seen."""
        from cmp_tactile_processing.calibration.proposal import find_views
        from cmp_tactile_processing.errors import FrameError
        from cmp_tactile_processing.sensor.description import VIEW_NAMES

        try:
            views = find_views(image, self._layout)
        except FrameError as error:
            return str(error)
        names = VIEW_NAMES if len(views) > 1 else ("view",)
        return {
            name: self._cells(name, view.seen.quality)
            for name, view in zip(names, views, strict=True)
        }

    def _cells(self, name: str, quality: MarkerQuality) -> dict[str, str]:
        best = self._best[name] = min(quality.blur_px, self._best.get(name, quality.blur_px))
        um = 1e6 * self._pitch
        values = {
            "px per checker": ("side_px", f"{quality.side_px:.1f}"),
            "blur": ("blur_px", f"{quality.blur_px:.2f} px, best {best:.2f}"),
            "contrast": ("contrast", f"{quality.contrast:.0f}"),
            "noise": ("noise", f"{quality.noise:.1f}"),
        }
        cells = {
            heading: f"{text} ({um * quality.std_if(key):.2f} um)"
            for heading, (key, text) in values.items()
        }
        advice = [*quality.advice(HINT_GAIN), "nothing: a good picture"]
        return {
            **cells,
            "overexposed": f"{quality.saturated:.0%}",
            "marker": f"{um * quality.std_pitch:.2f} um",
            "next": advice[0],
        }


@dataclass(frozen=True, kw_only=True)
class Init(Looking):
    """Write a first description of a sensor from a picture of its pattern at rest. The picture
    shows the views, rows, columns and colours, and the size and direction of the checkers. Two
    views of the whole pattern, in mirrors or by two cameras, also show where camera, mirrors and
    gel are. On a terminal you are asked for modulus and thickness of the gel. Values that nobody
    gave and no picture shows are assumed, and marked in the file. Next:
    `cmp_tactile sensor sensor:=FILE view:=true` shows a live displacement field, and
    `cmp_tactile calibrate gel` refines mirrors and gel.

    examples:
      cmp_tactile init /dev/video0 --pitch 0.69 --views one
      cmp_tactile init rest.png --pitch 0.69 --views mirrors --output my_sensor.yaml
    """

    picture: Annotated[
        str | None,
        argument(
            "PICTURE",
            "a sharp picture of the whole pattern; or a camera, as /dev/video0 (two with a comma "
            "between)",
        ),
    ] = None
    output: Annotated[
        Path, option("file to write; it must not exist yet", metavar="FILE", short="-o")
    ] = Path("my_sensor.yaml")
    angle_of_view: Annotated[
        float | None,
        option(
            "horizontal angle of view of the camera (default: what fits the picture, or 60)",
            Number(5, 150, "degrees"),
        ),
    ] = None
    code_seed: Annotated[
        int, option("number of the sheet, if it has dots", Number(0, LARGEST_SEED, kind=int))
    ] = 0
    young: Annotated[float | None, option("Young's modulus of the gel (default: 500)", YOUNG)] = (
        None
    )
    thickness: Annotated[
        float | None, option("thickness of the gel, to the outer surface (default: 5)", THICKNESS)
    ] = None

    def run(self) -> int:
        """Propose, ask, write, and say what the picture is worth."""
        from cmp_tactile_processing.cache.files import write_whole
        from cmp_tactile_processing.errors import OutputError
        from cmp_tactile_processing.sensor.description import sensor_description_of
        from cmp_tactile_processing.sensor.yaml_file import parse_yaml

        output = expanded_path(self.output)
        if output.exists():
            msg = f"{output}: found a file, expected a new name; give another one with --output"
            raise OutputError(msg)
        if self.picture is None and not self.asks:
            misuse("PICTURE: found nothing, expected a picture or a camera")
        name = self.picture or self.ask("Picture or camera", f"{DEVICES}video0", str)
        pitch = self.pitch_m()
        found = self._proposal(self._taken(name), pitch)
        text = self._text(found)
        # As a file is read: what its reader refuses is not written.
        sensor_description_of(parse_yaml(output, text))
        write_whole(output, text)
        _report(found, output)
        return 0

    def _taken(self, name: str) -> NDArray[np.uint8]:
        """The picture, or one from the camera once its exposure has settled, grey."""
        from cmp_tactile_processing.errors import FrameSourceError

        count = FRAMES_TO_SETTLE if name.startswith(DEVICES) else 1
        with closing(self.frames(name)) as frames:
            taken = list(islice((image for image in frames if image is not None), count))
        if not taken:
            msg = f"{name}: found no frame, expected a picture or a camera"
            raise FrameSourceError(msg)
        return taken[-1]

    def _proposal(self, image: NDArray[np.uint8], pitch: float) -> Proposal:
        from cmp_tactile_processing.calibration.proposal import Known, propose

        print("counting the corners ...", file=sys.stderr)
        known = Known(pitch, self.angle_of_view, self.code_seed)
        choose = self._ask_for_views if self.asks else None
        found = propose(image, known, self.output.stem, self.views or "", choose)
        gel = found.sensor.elastomer
        young = self.young or self.ask(
            "Young's modulus of the gel, kPa", gel.young / 1e3, YOUNG.parse
        )
        depth = self.thickness or self.ask(
            "Thickness of the gel, mm", gel.size[2] * 1e3, THICKNESS.parse
        )
        gel = replace(gel, young=1e3 * young, size=(*gel.size[:2], depth / 1e3))
        return replace(found, sensor=replace(found.sensor, elastomer=gel))

    def _ask_for_views(self, reason: str, layouts: tuple[str, ...]) -> str:
        return self.ask(f"{reason}\nViews ({', '.join(layouts)})", "", Choice(layouts).parse)

    def _text(self, found: Proposal) -> str:
        """The file of the description, what is assumed marked."""
        from cmp_tactile_processing.calibration.counting import THICKNESS_M, YOUNG_PA
        from cmp_tactile_processing.sensor.description import sensor_description_text
        from cmp_tactile_processing.sensor.parts import Uncertainty

        gel, assumed = found.sensor.elastomer, list(ASSUMED)
        if found.layout == "one":
            assumed += OF_ONE_VIEW[:2] if self.angle_of_view else OF_ONE_VIEW
        if self.young is None and gel.young == YOUNG_PA:
            assumed.append("young:")
        if self.thickness is None and gel.size[2] == THICKNESS_M:
            assumed.append("size:")
        std = dict(named for key, named in ASSUMED_STD.items() if key in assumed)
        known = Uncertainty({**std, **_optical_std(found.sensor)}, assumed=tuple(std))
        sensor = replace(found.sensor, uncertainty=known)
        marked = (
            f"{line}{',' if '#' in line else '  #'} assumed"
            if line.strip().startswith(tuple(assumed))
            else line
            for line in sensor_description_text(sensor).splitlines()
        )
        return "".join(f"{line}\n" for line in marked)


def _optical_std(sensor: SensorDescription) -> dict[str, float]:
    """Deviations of the cameras' values, of which one picture shows little."""
    owners = ["camera"] if sensor.camera else [f"views.{name}.camera" for name in sensor.views]
    centre = CENTRE_STD * sensor.image.width
    return {
        f"{owner}.{key}": std
        for owner in owners
        for key, std in (("fx", FOCAL_STD), ("cx", centre), ("cy", centre))
    }


def _report(found: Proposal, output: Path) -> None:
    pattern, two = found.sensor.pattern, found.layout != "one"
    end = {
        "in_view": "ends within the picture on all sides",
        "beyond_view": "continues beyond the picture",
    }
    how = {"one": "", "mirrors": " in two mirrors", "cameras": " in the pictures of two cameras"}[
        found.layout
    ]
    seen = f"{pattern.rows} x {pattern.cols} corners{how}"
    code = f" with dots (seed {pattern.code_seed})" if pattern.code != "none" else ""
    print(f"{seen}{code}, and the pattern {end[pattern.border]}")
    if found.note:
        print(f"to do: {found.note}")
    for name, view in found.views.items():
        quality = view.seen.quality
        print(
            f"{f'{name} view: ' if two else ''}checkers of {quality.side_px:.1f} px; contrast "
            f"{quality.contrast:.0f} grey levels; noise {quality.noise:.1f}; "
            f"blur {quality.blur_px:.2f} px; standard deviation of a marker "
            f"{1e6 * pattern.pitch * quality.std_pitch:.1f} um"
        )
        for advice in quality.advice(LEAST_GAIN):
            print(f"to do: {advice}")
    if two:
        print(f"corners agree with the description to {found.misfit_px:.2g} px")
    print(f"written: {output}; assumed values are marked in it")
    quoted = shlex.quote(str(output))
    print(f"next: cmp_tactile sensor sensor:={quoted} view:=true")
    if two:
        print(f"then: cmp_tactile calibrate gel FRAMES --sensor {quoted} --output calibrated.yaml")
