#!/usr/bin/env python3
"""Patterns that go on beyond the view: which corners get a number, and which numbers are wrong.

The first part uses recordings of a pattern with a border. Its middle is tracked as a part of a
larger pattern. The whole pattern, which the border numbers, gives the truth. The second part
renders a sheet of 60 x 60 corners with exact truth, with a code and without: slides, covers and
knocks, each after a frame at rest. Each view shows some 1,900 corners, and 25 x 25 are numbered.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
import cv2
import numpy as np
from detectors import Detection, Ours
from inputs import Input, add_options, chosen
from numpy.typing import NDArray
from tables import CommandLine, head, line

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import PatternSurface
from hard_frames.covers import COVERS, Cover, far_from_edge
from hard_frames.deformation import Deformation, Zone, deformation_of
from hard_frames.grid_score import WRONG_SHARE
from hard_frames.studio import PatternCase, PatternStudio

# Of the corners along each side of a recording's pattern such shares are numbered.
NUMBERED = (0.4, 0.6, 0.8)
# Of a sheet: corners along a side that are numbered, and what the gel must measure to hold it, m.
PART, PITCH_M, SKIN_M = 25, 5.8e-4, 0.05
# In checkers, along x and y.
SLIDES = ((2, 0), (0, -3), (-5, 5), (8, 0), (0, 11), (-14, 3))
KNOCKS = ((2, 0), (1, 1), (-2.2, 0.5))
SHARES = (0.2, 0.4, 0.6, 0.8)
# A zone so wide moves the whole gel.
EVERYWHERE_M = 1.0


@dataclass
class Count:
    """What became of views: their number, those with numbers, and corners of all of them.

    far: corners two checkers from what hides the others and from the image's edge.
    """

    views: int = 0
    numbered: int = 0
    wrong: int = 0
    far: int = 0
    found_far: int = 0
    seconds: list[float] = field(default_factory=list)

    def add(self, found: Detection, truth: NDArray[np.float64], far: NDArray[np.bool_]) -> None:
        """Take a view's grid; truth (rows, cols, 2) px, NaN where a corner is not known."""
        corners = found.grid.corners
        error = np.linalg.norm(corners - truth, axis=-1)
        side = float(np.nanmedian(np.linalg.norm(np.diff(truth, axis=1), axis=-1)))
        right = error < WRONG_SHARE * side
        self.views += 1
        self.numbered += bool(np.isfinite(corners).any())
        self.wrong += int(np.count_nonzero(np.isfinite(error) & ~right))
        self.far += int(np.count_nonzero(far))
        self.found_far += int(np.count_nonzero(far & right))
        self.seconds.append(found.seconds)

    def row(self, name: str) -> str:
        """A line of the table."""
        without, far = self.views - self.numbered, f"{self.found_far} of {self.far}"
        ms = f"{1e3 * float(np.median(self.seconds)):.1f}"
        return line(name, self.views, self.numbered, without, self.wrong, far, ms)


COLUMNS = (
    "frames", "views", "numbered", "without numbers", "wrong corners", "far corners numbered",
    "processor time, ms",
)  # fmt: skip


def part_of(sensor: SensorDescription, rows: int, cols: int) -> SensorDescription:
    """The sensor with the middle of its pattern numbered, as if it went on beyond the view."""
    pattern = replace(sensor.pattern, rows=rows, cols=cols, border="beyond_view")
    return replace(sensor, pattern=pattern)


def track(
    tracker: Ours, sensor: SensorDescription, image: NDArray[np.uint8]
) -> Iterator[tuple[str, Detection]]:
    """Name of each view, and what is found in it of the next frame."""
    for name, view in build_views(sensor).items():
        yield name, tracker.track(sensor, name, split_frame(image, view.placement))


def recorded(given: Input) -> Iterator[tuple[str, Count]]:
    """Parts of a recording's pattern, against the whole of it; what that misses is not judged."""
    images = [image for image, _ in given.frames()]
    tracker, sensor = Ours("cmp_tactile", cold=False), given.sensor
    truth = [dict(track(tracker, sensor, image)) for image in images]
    rows, cols = sensor.pattern.rows, sensor.pattern.cols
    for share in NUMBERED:
        beside = [round((1 - share) / 2 * side) for side in (rows, cols)]
        inner = tuple(
            slice(skip, side - skip) for skip, side in zip(beside, (rows, cols), strict=True)
        )
        size = [part.stop - part.start for part in inner]
        part, count = part_of(sensor, *size), Count()
        for image, known in zip(images, truth, strict=True):
            for name, found in track(tracker, part, image):
                corners = known[name].grid.corners[inner]
                count.add(found, corners, np.isfinite(corners[..., 0]))
        yield f"{given.name}, {size[0]} x {size[1]} of {rows} x {cols} numbered", count


def sheet(code: str) -> SensorDescription:
    """The sample rig over a sheet that goes on beyond both of its views."""
    sensor = load_sensor("sample_rig")
    pattern = replace(sensor.pattern, pitch=PITCH_M, surface=PatternSurface(), code=code)
    gel = replace(sensor.elastomer, size=(SKIN_M, SKIN_M, sensor.elastomer.size[2]))
    return part_of(replace(sensor, pattern=pattern, elastomer=gel), PART, PART)


def cases(sensor: SensorDescription) -> dict[str, list[PatternCase]]:
    """Frames by what is hard about them."""
    pattern = sensor.pattern

    def moved(x: float, y: float, kind: str = "rest") -> Deformation:
        shift = x * pattern.pitch, y * pattern.pitch
        return (*deformation_of(kind, pattern), Zone(radius=EVERYWHERE_M, shift=shift))

    found = {
        "slides of 2 to 14 checkers": [
            PatternCase("slid", sensor, moved(*slide, kind))
            for slide in SLIDES
            for kind in ("rest", "twist")
        ],
        "knocks of 2 checkers, with a contact": [
            PatternCase("knocked", sensor, moved(*knock, "press")) for knock in KNOCKS
        ],
    }
    for share in SHARES:
        found[f"{share:.0%} hidden"] = [
            PatternCase(
                "hidden",
                sensor,
                moved(0.2 * number, 0, kind),
                cover=Cover(shape, share),
                seed=number,
            )
            for number, shape in enumerate(COVERS)
            for kind in ("rest", "slide")
        ]
    return found


def rendered(studio: PatternStudio, sensor: SensorDescription) -> Iterator[tuple[str, Count]]:
    """Cases on a sheet, each after a frame at rest."""
    tracker = Ours("cmp_tactile", cold=False)
    rest = studio.photograph(PatternCase("rest", sensor)).image
    dots = "with" if sensor.pattern.code != "none" else "without"
    for name, several in cases(sensor).items():
        count = Count()
        for case in several:
            frame = studio.photograph(case)
            tracker.reset()
            list(track(tracker, sensor, rest))
            for view, found in track(tracker, sensor, frame.image):
                truth = frame.truth[view]
                size = truth.placement.height, truth.placement.width
                far = frame.far[view] & far_from_edge(truth.corners, size)
                count.add(found, truth.corners, far)
        yield f"sheet {dots} dots, {name}", count


def main() -> None:
    """Print the table."""
    parser = CommandLine((__doc__ or "").partition("\n\n")[0])
    add_options(parser)
    parser.set_defaults(input=("grasp",))
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print(head(*COLUMNS))
    studio = PatternStudio()
    found = [recorded(given) for given in chosen(options)]
    found += [rendered(studio, sheet(code)) for code in ("none", "dots")]
    for name, count in itertools.chain.from_iterable(found):
        print(count.row(name), flush=True)


if __name__ == "__main__":
    main()
