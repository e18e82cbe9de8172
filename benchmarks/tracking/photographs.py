"""Real pictures: what the tracker finds on a print that goes on beyond the picture.

python3 benchmarks/tracking/photographs.py                       the pictures of the repository
python3 benchmarks/tracking/photographs.py --side 9.6 FILE...    yours; side of a checker, px
--overlays FOLDER writes each picture with its corners.

Pictures of one size and side count as frames of one recording. Without truth, three things can be
checked: that numbers and colours agree everywhere, that the image around a numbered corner is dark
and light like a corner, and how smoothly corners lie along their gridlines. The detector alone also
finds corners that get no number. They are checked as connected sets.
"""

from __future__ import annotations

import argparse
import sys
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from time import thread_time

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.image.prepared import Prefilter
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.description import SensorDescription, sensor_description_of
from cmp_tactile_processing.sensor.yaml_file import parse_yaml
from cmp_tactile_processing.tracking.corners.saddle_lattice import SaddleLattice
from cmp_tactile_processing.tracking.detector import STEPS, CornerGraph, NominalGrid
from cmp_tactile_processing.tracking.numbering.components import GridlinePointers
from cmp_tactile_processing.tracking.tracker import GridTracker

FOLDER = Path(__file__).parents[2] / "test" / "data" / "photographs"
# Side of a checker, px.
SIDES_PX = {"flat_rest": 9.61, "ring_1": 9.66, "wave_rest": 11.70, "wave": 11.19}
# The combination's own noise is so many times a corner's, and a deviation 1.48 times the median.
OWN_NOISE, DEVIATION = 1.39, 1.4826
SUBPIX_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 1e-3)
PITCH_M, DISTANCE_M = 0.001, 0.2
COLOURS = {1: (0, 200, 0), 2: (0, 140, 255)}
WITHOUT_NUMBER = (255, 120, 0)
# A corner that is numbered lies so near to where the detector found it, in sides.
SAME = 0.3
MAGNIFIED = 2

Float = NDArray[np.float64]
Image = NDArray[np.uint8]


def sheet(side_px: float, size: tuple[int, int]) -> SensorDescription:
    """A camera straight above a print with checkers of that side; size: width, height, px.

    As many corners are numbered as fit into the picture.
    """
    width, height = size
    rows, cols = (int(extent / side_px) - 1 for extent in (height, width))
    focal = side_px * DISTANCE_M / PITCH_M
    block = [(count + 20) * PITCH_M for count in (cols, rows)]
    text = f"""\
version: 1
name: sheet
image: {{width: {width}, height: {height}}}
camera: {{model: pinhole, fx: {focal}, fy: {focal}, cx: {(width - 1) / 2}, cy: {(height - 1) / 2},
  distortion: [0.0, 0.0, 0.0, 0.0, 0.0]}}
optics:
  type: monocular
  T_camera_gel: [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, {DISTANCE_M}]]
  layers: []
views: {{left: {{roi: [0, 0, {width}, {height}]}}}}
pattern: {{rows: {rows}, cols: {cols}, pitch: {PITCH_M}, corner_checker: dark,
  points_per_segment: 2, surface: {{type: plane}}, border: beyond_view}}
elastomer: {{size: [{block[0]}, {block[1]}, 0.01], young: 500000.0, poisson: 0.48, model: linear,
  shading_layer: {{thickness: 0.0003, young: 500000.0}}}}
"""
    return sensor_description_of(parse_yaml(Path("sheet.yaml"), text))


def roughness(corners: Float) -> tuple[float, float]:
    """Deviation of a corner, px, from the cubics through two neighbours on either side.

    corners (rows, cols, 2) px.  Along columns and along rows, robust, over what the combination of
    five corners makes of the deviation of one.
    """
    found = []
    for axis in (0, 1):
        line = np.moveaxis(corners, axis, 0)
        near, far = line[1:-3] + line[3:-1], line[:-4] + line[4:]
        off = line[2:-2] - (4 * near - far) / 6
        off = off[np.isfinite(off)]
        found.append(DEVIATION * float(np.median(np.abs(off))) / OWN_NOISE if len(off) else np.nan)
    return found[0], found[1]


def colours_that_disagree(image: Image, corners: Float) -> tuple[int, int]:
    """Checkers with four known corners that are not as dark or light as their numbers say, of all.

    A checker is dark if its middle third is darker than its four neighbours.
    """
    centre = (corners[:-1, :-1] + corners[1:, :-1] + corners[:-1, 1:] + corners[1:, 1:]) / 4
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float64)
    known = np.isfinite(centre[..., 0])
    x, y = np.rint(np.where(known[..., None], centre, 0)).astype(int).transpose(2, 0, 1)
    grey = np.where(known, smooth[y, x], np.nan)
    inner = grey[1:-1, 1:-1]
    beside = (grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:]) / 4
    i, j = np.indices(grey.shape)
    sign = np.where((i + j) % 2 == 0, 1.0, -1.0)[1:-1, 1:-1]
    # The checker inside corner (0, 0) is of the colour of the one outside it.
    agrees = sign * (beside - inner) > 0
    judged = np.isfinite(inner) & np.isfinite(beside)
    return int(np.count_nonzero(judged & ~agrees)), int(np.count_nonzero(judged))


@dataclass(frozen=True)
class Detected:
    """What the detector alone finds.

    unnumbered (n, 2) px: corners that the grid lacks.  disagree: as `colours_that_disagree`, of
    connected sets of these.  open_pointers: pointers that contradict the others about how many
    corners lie between two, of how many.
    """

    unnumbered: Float
    disagree: tuple[int, int]
    open_pointers: tuple[int, int]


def detect(sensor: SensorDescription, image: Image, grid: Grid) -> Detected:
    """Detect a picture whole, and compare with what the tracker numbered of it."""
    nominal = NominalGrid.of_view(sensor.pattern, build_views(sensor)["left"])
    prepared = Prefilter(image.shape, nominal.side_px).prepare(image.copy())
    graph = SaddleLattice(nominal, image.shape).corner_graph(prepared)
    numbered = cKDTree(grid.corners[np.isfinite(grid.corners[..., 0])])
    limit = SAME * nominal.side_px
    unnumbered = graph.position[numbered.query(graph.position)[0] > limit]
    wrong = judged = 0
    for component in GridlinePointers().components(graph, *nominal.axes_near(graph.position)):
        if np.median(numbered.query(component.position)[0]) > limit:
            lattice, even = component.lattice()
            first = np.full((0 if even else 1, *lattice.shape[1:]), np.nan)
            found = colours_that_disagree(image, np.concatenate([first, lattice]))
            wrong, judged = wrong + found[0], judged + found[1]
    return Detected(unnumbered, (wrong, judged), _open_pointers(graph))


def _open_pointers(graph: CornerGraph) -> tuple[int, int]:
    """Pointers by which loops do not close, and all: of two that answer each other, one."""
    number: dict[int, NDArray[np.intp]] = {}
    for start in range(len(graph.position)):
        queue = deque([start] if start not in number else [])
        number.setdefault(start, np.zeros(2, dtype=np.intp))
        while queue:
            node = queue.popleft()
            for step, other in zip(STEPS, graph.neighbour[node].tolist(), strict=True):
                if other >= 0 and other not in number:
                    number[other] = number[node] + step
                    queue.append(other)
    node, towards = np.nonzero(graph.neighbour[:, 1:3] >= 0)
    other = graph.neighbour[:, 1:3][node, towards]
    numbers = np.array([number[index] for index in range(len(graph.position))])
    closed = (numbers[other] == numbers[node] + STEPS[1:3][towards]).all(axis=1)
    return int(np.count_nonzero(~closed)), len(closed)


@dataclass(frozen=True)
class Found:
    """What a picture gave: ours, and cornerSubPix started from our corners."""

    grid: Grid
    seconds: float
    disagree: tuple[int, int]
    rough: tuple[float, float]
    subpix: tuple[float, float]
    peers: dict[str, int]


def track(tracker: GridTracker, image: Image) -> Found:
    """Track one picture; the tracker goes on from what it saw before."""
    began = thread_time()
    grid = tracker.track(image)
    seconds = thread_time() - began
    start = np.nan_to_num(grid.corners, nan=20.0).reshape(-1, 1, 2).astype(np.float32)
    refined = cv2.cornerSubPix(image, start, (3, 3), (-1, -1), SUBPIX_STOP)
    refined = refined.reshape(grid.corners.shape).astype(np.float64)
    refined[np.isnan(grid.corners)] = np.nan
    size = grid.shape.cols, grid.shape.rows
    larger = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    classic = cv2.findChessboardCorners(image, size)
    sector = cv2.findChessboardCornersSB(image, (5, 5), larger)
    peers = {"classic": len(classic[1]) if classic[0] else 0}
    peers["SB"] = len(sector[1]) if sector[0] else 0
    disagree = colours_that_disagree(image, grid.corners)
    return Found(grid, seconds, disagree, roughness(grid.corners), roughness(refined), peers)


def overlay(image: Image, grid: Grid, unnumbered: Float) -> Image:
    """The picture, twice as large, with its corners.

    Measured ones green, predicted ones orange, those without a number (n, 2) px blue.
    """
    canvas = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    canvas = cv2.resize(canvas, None, fx=MAGNIFIED, fy=MAGNIFIED, interpolation=cv2.INTER_CUBIC)
    drawn = [(grid.corners[grid.corner_status == status], COLOURS[status]) for status in COLOURS]
    for chosen, colour in [*drawn, (unnumbered, WITHOUT_NUMBER)]:
        for x, y in np.rint(MAGNIFIED * (chosen + 0.5) - 0.5).astype(int).tolist():
            cv2.circle(canvas, (x, y), 2, colour, -1, cv2.LINE_AA)
    return np.asarray(canvas, dtype=np.uint8)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "files", nargs="*", type=Path, help="pictures of one print, in their order in time"
    )
    parser.add_argument("--side", type=float, help="side of a checker in the pictures, px")
    parser.add_argument(
        "--overlays", type=Path, help="write each picture with its corners into this folder"
    )
    given = parser.parse_args()
    if bool(given.files) != (given.side is not None):
        parser.error("found only one of files and --side, expected both or none")
    files = given.files or [FOLDER / f"{name}.png" for name in SIDES_PX]
    print("| picture | corners | numbers | checkers of a wrong colour | roughness "
          "| roughness of cornerSubPix | OpenCV classic / SB | time | corners without a number "
          "| their checkers of a wrong colour | pointers that close no loop |\n"
          + 11 * "|---" + "|")  # fmt: skip
    tracker, last = None, None
    for file in files:
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if image is None:
            sys.exit(f"{file}: found no picture that can be read")
        side, size = given.side or SIDES_PX[file.stem], image.shape[::-1]
        sensor = sheet(side, size)
        if tracker is None or (side, size) != last:
            tracker, last = GridTracker(sensor), (side, size)
        found = track(tracker, image)
        detected = detect(sensor, image, found.grid)
        known, shape = int(np.isfinite(found.grid.corners[..., 0]).sum()), found.grid.shape
        print(
            f"| {file.stem} | {known} of {shape.rows} x {shape.cols} "
            f"| {found.grid.fault.value or 'all'} | {found.disagree[0]} of {found.disagree[1]} "
            f"| {found.rough[0]:.3f}, {found.rough[1]:.3f} px "
            f"| {found.subpix[0]:.3f}, {found.subpix[1]:.3f} px "
            f"| {found.peers['classic']} / {found.peers['SB']} | {1e3 * found.seconds:.0f} ms "
            f"| {len(detected.unnumbered)} | {detected.disagree[0]} of {detected.disagree[1]} "
            f"| {detected.open_pointers[0]} of {detected.open_pointers[1]} |"
        )
        if given.overlays:
            given.overlays.mkdir(parents=True, exist_ok=True)
            drawn = overlay(image, found.grid, detected.unnumbered)
            cv2.imwrite(str(given.overlays / f"{file.stem}.png"), drawn)


if __name__ == "__main__":
    main()
