"""`cmp_tactile init`: a first sensor description from one picture of the gel at rest."""

from __future__ import annotations

import shlex
import sys
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cmp_tactile_bringup.commands.focus import DEVICES, LAYOUTS, Looking
from cmp_tactile_bringup.commands.options import Choice, Number, argument, misuse, option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cmp_tactile_processing.calibration.proposal import Proposal

YOUNG, THICKNESS = Number(1, 1e7, "kPa"), Number(0.5, 100, "mm")
# Keys of a description that no picture shows, and those that one view does not.
ASSUMED = "poisson:", "shading_layer:", "cx:", "cy:", "layers:"
OF_ONE_VIEW = "surface:", "distortion:", "fx:", "fy:"
# A camera adjusts its exposure in the first frames.
FRAMES_TO_SETTLE = 15
# What is worth doing before a sensor is used, of a marker's standard deviation.
LEAST_GAIN = 0.5


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
      cmp_tactile init /dev/video0 --pitch 0.69
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
    young: Annotated[float | None, option("Young's modulus of the gel (default: 500)", YOUNG)] = (
        None
    )
    thickness: Annotated[
        float | None, option("thickness of the gel, to the outer surface (default: 5)", THICKNESS)
    ] = None

    def run(self) -> int:
        """Propose, ask, write, and say what the picture is worth."""
        from cmp_tactile_bringup.errors import OutputError
        from cmp_tactile_processing.cache.files import write_whole
        from cmp_tactile_processing.sensor.description import sensor_description_of
        from cmp_tactile_processing.sensor.yaml_section import parse_yaml

        output = self.output.expanduser()
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
        from cmp_tactile_driver.errors import FrameSourceError

        count = FRAMES_TO_SETTLE if name.startswith(DEVICES) else 1
        with closing(self.frames(name)) as frames:
            taken = list(islice((image for image in frames if image is not None), count))
        if not taken:
            msg = f"{name}: found no frame, expected a picture or a camera"
            raise FrameSourceError(msg)
        return taken[-1]

    def _proposal(self, image: NDArray[np.uint8], pitch: float) -> Proposal:
        from cmp_tactile_processing.calibration.proposal import propose

        print("counting the corners ...", file=sys.stderr)
        found = propose(image, pitch, self.output.stem, self.views or "", self.angle_of_view)
        if self.views is None and found.layout != "one":
            question = (
                "Two views are seen. Are they in two mirrors or of two cameras (mirrors, cameras)?"
            )
            layout = self.ask(question, found.layout, Choice(LAYOUTS[1:]).parse)
            if layout != found.layout:
                found = propose(image, pitch, self.output.stem, layout, self.angle_of_view)
        gel = found.sensor.elastomer
        young = self.young or self.ask(
            "Young's modulus of the gel, kPa", gel.young / 1e3, YOUNG.parse
        )
        depth = self.thickness or self.ask(
            "Thickness of the gel, mm", gel.size[2] * 1e3, THICKNESS.parse
        )
        gel = replace(gel, young=1e3 * young, size=(*gel.size[:2], depth / 1e3))
        return replace(found, sensor=replace(found.sensor, elastomer=gel))

    def _text(self, found: Proposal) -> str:
        """The file of the description, what is assumed marked."""
        from cmp_tactile_processing.calibration.counting import THICKNESS_M, YOUNG_PA
        from cmp_tactile_processing.sensor.description import sensor_description_text

        gel, assumed = found.sensor.elastomer, list(ASSUMED)
        if found.layout == "one":
            assumed += OF_ONE_VIEW[:2] if self.angle_of_view else OF_ONE_VIEW
        if self.young is None and gel.young == YOUNG_PA:
            assumed.append("young:")
        if self.thickness is None and gel.size[2] == THICKNESS_M:
            assumed.append("size:")
        marked = (
            f"{line}{',' if '#' in line else '  #'} assumed"
            if line.strip().startswith(tuple(assumed))
            else line
            for line in sensor_description_text(found.sensor).splitlines()
        )
        return "".join(f"{line}\n" for line in marked)


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
    print(f"{seen}, and the pattern {end[pattern.border]}")
    for name, view in found.views.items():
        worth = view.seen.worth
        print(
            f"{f'{name} view: ' if two else ''}checkers of {worth.side_px:.1f} px; contrast "
            f"{worth.contrast:.0f} grey levels; noise {worth.noise:.1f}; blur {worth.blur_px:.2f} "
            f"px; standard deviation of a marker {1e6 * pattern.pitch * worth.std_pitch:.1f} um"
        )
        for advice in worth.advice(LEAST_GAIN):
            print(f"to do: {advice}")
    if two:
        print(f"corners agree with the description to {found.misfit_px:.2g} px")
    print(f"written: {output}; assumed values are marked in it")
    quoted = shlex.quote(str(output))
    print(f"next: cmp_tactile sensor sensor:={quoted} view:=true")
    if two:
        print(f"then: cmp_tactile calibrate gel FRAMES --sensor {quoted} --output calibrated.yaml")
