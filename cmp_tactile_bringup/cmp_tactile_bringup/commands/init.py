"""`cmp_tactile init`: a first sensor description from one picture of the gel at rest."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cmp_tactile_bringup.commands.options import Command, Number, argument, misuse, option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cmp_tactile_processing.calibration.proposal import Proposal

PITCH = Number(0.01, 50, "mm")
# Keys of a description that no picture shows.
ASSUMED = ("size:", "young:", "poisson:", "shading_layer:", "fx:", "fy:")
# A camera adjusts its exposure in the first frames.
FRAMES_TO_SETTLE = 15
# Below these a picture is to be made better first.
LEAST_SHARPNESS, LEAST_CONTRAST, LEAST_SIDE_PX = 0.75, 60.0, 10.0


@dataclass(frozen=True, kw_only=True)
class Init(Command):
    """Write a first description of a sensor with one view, from a picture of its pattern at rest:
    rows, columns and colours are counted, size and direction of the checkers measured. What a
    picture does not show (moduli, thickness, the camera's focal length) is assumed, and marked so
    in the file. `cmp_tactile sensor sensor:=FILE view:=true` then shows a live displacement field.

    Start from the description of a similar sensor where there are two views or mirrors: see
    docs/sensor_description.md.
    """

    picture: Annotated[
        str, argument("PICTURE", "of the whole pattern, sharp, or a camera, as /dev/video0")
    ]
    pitch: Annotated[
        float | None,
        option("side of a checker; asked for where it is not given", PITCH),
    ] = None
    output: Annotated[
        Path, option("file to write, which must not be there yet", metavar="FILE", short="-o")
    ] = Path("my_sensor.yaml")
    angle_of_view: Annotated[
        float | None,
        option(
            "of the camera, from left to right (default: what fits the picture, or 60)",
            Number(5, 150, "degrees"),
        ),
    ] = None

    def run(self) -> int:
        """Propose, write, and say what the picture is worth."""
        from cmp_tactile_bringup.errors import OutputError
        from cmp_tactile_processing.cache.files import write_whole
        from cmp_tactile_processing.calibration.proposal import propose
        from cmp_tactile_processing.sensor.description import sensor_description_of
        from cmp_tactile_processing.sensor.yaml_section import parse_yaml

        output = self.output.expanduser()
        if output.exists():
            msg = f"{output}: found a file, expected none; --output names another"
            raise OutputError(msg)
        image, pitch = _picture(self.picture), self.pitch or _asked_pitch()
        print("counting the corners ...", file=sys.stderr)
        found = propose(image, pitch / 1e3, output.stem, self.angle_of_view)
        text = _text(found)
        # As a file is read: what its reader refuses is not written.
        sensor_description_of(parse_yaml(output, text))
        write_whole(output, text)
        _report(found, output)
        return 0


def _asked_pitch() -> float:
    if sys.stdin is None or not sys.stdin.isatty():
        misuse("--pitch: found nothing, expected the side of a checker, mm")
    answer: float = typer.prompt("Side of a checker, mm", value_proc=PITCH.parse)
    return answer


def _picture(name: str) -> NDArray[np.uint8]:
    """The picture, or one from the camera, grey; FrameError where there is none."""
    from cmp_tactile_driver.sources.files import decode_file
    from cmp_tactile_processing.errors import FrameError
    from cmp_tactile_processing.geometry.split import to_grey

    device = re.fullmatch(r"/dev/video(\d+)", name)
    try:
        image = _photograph(int(device[1])) if device else decode_file(Path(name).expanduser())
    except FrameError as error:
        expected = "a picture or a camera"
        msg = f"{name}: found nothing that can be read, expected {expected} ({error})"
        raise FrameError(msg) from None
    return to_grey(image)


def _photograph(number: int) -> NDArray[np.uint8]:
    """A frame of a camera, once its exposure has settled; FrameError where there is none."""
    import cv2
    import numpy as np

    from cmp_tactile_processing.errors import FrameError

    camera, image = cv2.VideoCapture(number, cv2.CAP_V4L2), None
    for _ in range(FRAMES_TO_SETTLE):
        image = camera.read()[1]
    camera.release()
    if image is None:
        msg = "it gives no frames"
        raise FrameError(msg)
    return np.asarray(image, dtype=np.uint8)


def _text(found: Proposal) -> str:
    """The file of the description, what is assumed marked."""
    from cmp_tactile_processing.sensor.description import sensor_description_text

    lines = sensor_description_text(found.sensor).splitlines()
    marked = (
        f"{line}{',' if '#' in line else '  #'} assumed"
        if line.strip().startswith(ASSUMED)
        else line
        for line in lines
    )
    return "".join(f"{line}\n" for line in marked)


def _report(found: Proposal, output: Path) -> None:
    pattern = found.sensor.pattern
    end = {"in_view": "ends in sight on all sides", "beyond_view": "goes on beyond the picture"}
    print(f"{pattern.rows} x {pattern.cols} corners, and the pattern {end[pattern.border]}")
    print(
        f"checkers of {found.side_px:.1f} px; light and dark differ by {found.contrast:.0f} grey "
        f"levels at a noise of {found.noise:.1f}; edges {found.sharpness:.2f} sharp (of 1)"
    )
    print(f"each marker is known to {1e6 * found.std_m:.1f} um in the plane")
    for is_bad, advice in (
        (found.sharpness < LEAST_SHARPNESS, "out of focus or smeared: focus, or expose shorter"),
        (found.contrast < LEAST_CONTRAST, "little contrast: more light, or a blacker print"),
        (found.side_px < LEAST_SIDE_PX, "small checkers: go nearer, or print them larger"),
    ):
        if is_bad:
            print(f"to do: {advice}")
    print(f"written: {output}; what is assumed is marked in it")
    print(f"next: cmp_tactile sensor sensor:={output} view:=true")
