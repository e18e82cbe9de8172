"""Frames of a pattern deformed by hand, with all that makes frames hard, and what is true of them.

They are for testing trackers: made in a tenth of a second, exact, and without any mechanics.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.library import load_sensor
from cmp_tactile_processing.sensor.parts import Pattern, PatternSurface
from cmp_tactile_simulation.hard_frames.deformation import Deformation, deform
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import (
    HOUSING_GREY,
    LIGHT_GREY,
    Checkerboard,
    PrintDefects,
)
from cmp_tactile_simulation.rendering.optical_truth import OpticalTruth
from cmp_tactile_simulation.rendering.random_streams import Purpose, random_stream
from cmp_tactile_simulation.rendering.renderer import RenderedFrame, Renderer

# What a camera sees beside the gel: parts of the housing, lamps.

# Sides of a part and spread of a lamp's light, px of the frame; light of a lamp, grey levels.
PART_SIDES = (20.0, 130.0), (8.0, 45.0)
LAMP_SPREAD = (5.0, 9.0)
LAMP_LIGHT = 600.0
PART_GREYS = (5.0, 245.0)
# The housing is the darkest of what is rendered; a rim of it is mixed with the skin.
RIM = 1.0


@dataclass(frozen=True)
class Scenery:
    """Number of flat parts that lie on the housing beside the skin, and of lamps there."""

    parts: int = 0
    lamps: int = 0

    def paint(
        self, grey: NDArray[np.float32], fineness: int, rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """The rendered greys with parts and lamps where the housing was seen."""
        if not (self.parts or self.lamps):
            return grey
        housing = np.abs(grey - HOUSING_GREY) < RIM
        places = np.argwhere(housing[::8, ::8]) * 8
        if not len(places):
            return grey
        scene = grey.copy()
        for _ in range(self.parts):
            v, u = places[rng.integers(len(places))]
            sides = [rng.uniform(*limits) * fineness for limits in PART_SIDES]
            box = cv2.boxPoints(((float(u), float(v)), tuple(sides), float(rng.uniform(0, 180))))
            cv2.fillConvexPoly(
                scene, np.rint(box).astype(np.int32), float(rng.uniform(*PART_GREYS))
            )
        scene = np.where(housing, scene, grey)
        for _ in range(self.lamps):
            v, u = places[rng.integers(len(places))]
            spread = rng.uniform(*LAMP_SPREAD) * fineness
            down = np.exp(-((np.arange(grey.shape[0]) - v) ** 2) / (2 * spread**2))
            across = np.exp(-((np.arange(grey.shape[1]) - u) ** 2) / (2 * spread**2))
            scene += (LAMP_LIGHT * np.outer(down, across)).astype(np.float32)
        return np.asarray(scene, dtype=np.float32)


# Things between gel and camera that hide a part of the pattern.

Box = tuple[float, float, float, float]
INF = float("inf")


def _boxes(share: float) -> dict[str, tuple[Box, ...]]:
    """What the shapes with straight sides cover: boxes (left, right, top, bottom).

    Places are 0 to 1 between the pattern's sides in the image, less and more beyond them.
    """
    left, right = (-INF, share, -INF, INF), (1 - share, INF, -INF, INF)
    top, bottom = (-INF, INF, -INF, share), (-INF, INF, 1 - share, INF)
    low, high = (1 - share) / 2, (1 + share) / 2
    return {
        "left": (left,),
        "right": (right,),
        "top": (top,),
        "bottom": (bottom,),
        "left_top": (left, top),
        "right_bottom": (right, bottom),
        "band_across": ((-INF, INF, low, high),),
        "band_down": ((low, high, -INF, INF),),
    }


COVERS = (*_boxes(0.5), "disc")
# Centre of the disc, between the pattern's sides.
DISC_AT = 0.55, 0.45
# Grains of the texture, px.
GRAIN = 3.0


@dataclass(frozen=True)
class Cover:
    """An opaque thing in front of each view.

    shape: one of COVERS.  share: part of the pattern's width, height or diameter that it hides.
    grey: 0 to 255, where light skin is 205 and dark ink 45.  texture: standard deviation of its
    grey.  Raises ParameterError for another shape.
    """

    shape: str = "left"
    share: float = 1 / 3
    grey: float = 110.0
    texture: float = 0.0

    def __post_init__(self) -> None:
        if self.shape not in COVERS:
            msg = f"cover.shape: found {self.shape!r}, expected one of {', '.join(COVERS)}"
            raise ParameterError(msg)

    def mask(
        self, corners: NDArray[np.float64], size: tuple[int, int], fineness: int = 1
    ) -> NDArray[np.bool_]:
        """What it hides of a view of that size (height, width), each pixel cut in fineness^2.

        corners (..., 2) px of the view: the pattern's true corners, NaN where there is none.
        """
        low, high = (pick(corners.reshape(-1, 2), axis=0) for pick in (np.nanmin, np.nanmax))
        x, y = (
            ((np.arange(count * fineness) + 0.5) / fineness - 0.5 - start)
            for count, start in zip(size[::-1], low, strict=True)
        )
        width, height = (float(extent) for extent in high - low)
        if self.shape == "disc":
            radius = self.share * min(width, height) / 2
            across, down = x - DISC_AT[0] * width, y[:, None] - DISC_AT[1] * height
            return np.asarray(across**2 + down**2 < radius**2)
        mask = np.zeros((len(y), len(x)), np.bool_)
        u, v = x / width, y[:, None] / height
        for left, right, top, bottom in _boxes(self.share)[self.shape]:
            mask |= (u > left) & (u < right) & (v > top) & (v < bottom)
        return mask

    def greys(self, shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float32]:
        """Its greys, everywhere in an image of that shape."""
        if self.texture == 0:
            return np.full(shape, self.grey, dtype=np.float32)
        noise = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), GRAIN)
        greys = self.grey + noise * (self.texture / float(noise.std()))
        return np.asarray(greys.clip(0, 255), dtype=np.float32)


# Cases, and the frames that are made of them.

# A corner is far from what hides others at so many sides of its checkers.
FAR_CELLS = 2.0
# A corner in the middle of so many pixels that are all white shows nothing.
BLOWN_OUT_PX, WHITE = 5, 254
# The checkers that meet at a corner are looked at this share of a side from it, along x and y.
BESIDE_CORNER = 0.15
# With less between light and dark, grey levels, nothing is visible.
LEAST_CONTRAST = 3.0
PATTERN_EXTENT = 0.0145
KEPT_RENDERERS = 4


def pattern_rig(  # noqa: PLR0913 - one keyword for each way in which rigs differ
    rows: int = 20,
    cols: int = 20,
    *,
    corner_checker: str = "dark",
    surface: PatternSurface | None = None,
    points_per_segment: int = 6,
    base: str = "sample_rig",
) -> SensorDescription:
    """The rig of that name with another pattern of the same extent, 14.5 mm along its longer side.

    surface: default that of the rig.
    """
    sensor = load_sensor(base)
    pattern = replace(
        sensor.pattern,
        rows=rows,
        cols=cols,
        pitch=PATTERN_EXTENT / (max(rows, cols) + 1),
        corner_checker=corner_checker,
        points_per_segment=points_per_segment,
        surface=surface or sensor.pattern.surface,
    )
    name = f"{sensor.name}_{rows}x{cols}_{corner_checker}_{pattern.surface.type}"
    return replace(sensor, name=name, pattern=pattern)


@dataclass(frozen=True)
class PatternCase:
    """One frame to be made.

    margin: grey of the skin around the checkers (light skin 205, dark ink 45).
    seed: of print defects, scenery and dirt.  frame: its noise differs from that of other frames.
    """

    name: str
    sensor: SensorDescription
    deformation: Deformation = ()
    camera: CameraSettings = field(default_factory=CameraSettings)
    defects: PrintDefects = field(default_factory=PrintDefects)
    margin: float = LIGHT_GREY
    scenery: Scenery = field(default_factory=Scenery)
    cover: Cover | None = None
    seed: int = 0
    frame: int = 0


@dataclass(frozen=True)
class PatternFrame:
    """A frame and what is true of it.

    image (height, width) uint8.  truth: exact grid of each view, in px of the view, hidden parts
    included.  visible, far: per view (rows, cols); a corner is visible where nothing covers it,
    neither light nor a blob of ink blots it out, and far where it is also two checkers from what
    is covered.
    """

    name: str
    sensor: SensorDescription
    image: NDArray[np.uint8]
    truth: Mapping[str, Grid]
    visible: Mapping[str, NDArray[np.bool_]]
    far: Mapping[str, NDArray[np.bool_]]


class PatternStudio:
    """Makes frames of cases; keeps what cases of the same sensor and print share.

    samples: of a pixel, along each side.  threads: default that of numba.
    """

    def __init__(self, samples: int = 4, threads: int | None = None) -> None:
        self._samples, self._threads = samples, threads
        self._renderers: list[tuple[SensorDescription, Checkerboard, Renderer]] = []
        self._truths: list[tuple[SensorDescription, OpticalTruth]] = []

    def photograph(self, case: PatternCase) -> PatternFrame:
        """The frame of a case.  Raises GeometryError for a sensor without a block."""
        surface = deform(case.sensor, case.deformation)
        rendered = self._renderer(case).render(surface)
        truth = self._truth(case.sensor).grids(surface)
        scenery_rng = random_stream(Purpose.SCENERY, case.seed)
        grey = case.scenery.paint(rendered.grey, rendered.fineness, scenery_rng)
        covered = {name: np.zeros((0, 0), np.bool_) for name in truth}
        if case.cover is not None:
            cover_rng = random_stream(Purpose.COVER, case.seed)
            grey, covered = _covered(grey, rendered.fineness, truth, (case.cover, cover_rng))
        noise = random_stream(Purpose.FRAME_NOISE, case.seed, case.frame)
        image = expose([RenderedFrame(grey, rendered.fineness)], case.camera, noise, case.seed)
        shown = _printed(case.sensor.pattern, case.defects, case.seed)
        shown &= case.camera.light_level - case.camera.dark_level >= LEAST_CONTRAST
        visible = {
            name: shown & _visible(image, grid, covered[name]) for name, grid in truth.items()
        }
        far = {
            name: visible[name] & far_corners(grid.corners, covered[name])
            for name, grid in truth.items()
        }
        return PatternFrame(case.name, case.sensor, image, truth, visible, far)

    def _renderer(self, case: PatternCase) -> Renderer:
        ink = Checkerboard(case.sensor.pattern, case.defects, case.seed, case.margin)
        for sensor, known, renderer in self._renderers:
            if sensor is case.sensor and known == ink:
                return renderer
        renderer = Renderer(case.sensor, ink, self._samples, self._threads)
        self._renderers = [(case.sensor, ink, renderer), *self._renderers][:KEPT_RENDERERS]
        return renderer

    def _truth(self, sensor: SensorDescription) -> OpticalTruth:
        for known, truth in self._truths:
            if known is sensor:
                return truth
        truth = OpticalTruth(sensor)
        self._truths = [(sensor, truth), *self._truths][:KEPT_RENDERERS]
        return truth


def degrade(
    frame: PatternFrame, camera: CameraSettings, cover: Cover | None = None, seed: int = 0
) -> PatternFrame:
    """A frame of any origin seen through a further camera, with a cover in front of it.

    Its greys are taken for light: that camera's light_level and dark_level are of 205 and 45.
    """
    grey = frame.image.astype(np.float32)
    covered = {name: np.zeros((0, 0), np.bool_) for name in frame.truth}
    if cover is not None:
        grey, covered = _covered(grey, 1, frame.truth, (cover, random_stream(Purpose.COVER, seed)))
    image = expose([RenderedFrame(grey, 1)], camera, random_stream(Purpose.FRAME_NOISE, seed), seed)
    visible = {
        name: frame.visible[name] & _visible(image, grid, covered[name])
        for name, grid in frame.truth.items()
    }
    far = {
        name: frame.far[name] & visible[name] & far_corners(grid.corners, covered[name])
        for name, grid in frame.truth.items()
    }
    return replace(frame, image=image, visible=visible, far=far)


def far_corners(
    corners: NDArray[np.float64], covered: NDArray[np.bool_], cells: float = FAR_CELLS
) -> NDArray[np.bool_]:
    """Which of the corners (rows, cols, 2) px lie that many checkers from what is covered.

    covered: mask of the view, (height, width), or empty where nothing is.
    """
    far = np.isfinite(corners[..., 0])
    if not covered.any():
        return far
    steps = [np.linalg.norm(np.gradient(corners, axis=axis), axis=-1) for axis in (0, 1)]
    side = np.fmax(*steps)
    distance = cv2.distanceTransform((~covered).astype(np.uint8), cv2.DIST_L2, 5)
    x, y = _pixel(corners, covered.shape)
    return np.asarray(far & (distance[y, x] >= cells * side))


def _covered(
    grey: NDArray[np.float32],
    fineness: int,
    truth: Mapping[str, Grid],
    cover: tuple[Cover, np.random.Generator],
) -> tuple[NDArray[np.float32], dict[str, NDArray[np.bool_]]]:
    """Greys with the cover in front, and what it hides of each view."""
    thing, rng = cover
    painted, masks = grey.copy(), {}
    for name, grid in truth.items():
        place = grid.placement
        if place is None:
            continue
        size = place.height, place.width
        rows = slice(place.y * fineness, (place.y + place.height) * fineness)
        part = painted[rows, place.x * fineness : (place.x + place.width) * fineness]
        part = part[:, ::-1] if place.flipped else part
        mask = thing.mask(grid.corners, size, fineness)
        part[mask] = thing.greys((part.shape[0], part.shape[1]), rng)[mask]
        masks[name] = thing.mask(grid.corners, size)
    return painted, masks


def _visible(image: NDArray[np.uint8], grid: Grid, covered: NDArray[np.bool_]) -> NDArray[np.bool_]:
    visible = np.isfinite(grid.corners[..., 0])
    if covered.any():
        x, y = _pixel(grid.corners, covered.shape)
        visible &= ~covered[y, x]
    darkest = cv2.erode(image, np.ones((BLOWN_OUT_PX, BLOWN_OUT_PX), np.uint8))
    x, y = _pixel(grid.corners_frame, image.shape)
    return np.asarray(visible & (darkest[y, x] < WHITE))


def _printed(pattern: Pattern, defects: PrintDefects, seed: int) -> NDArray[np.bool_]:
    """Corners (rows, cols) around which blobs leave three of the four checkers as they should be.

    Ragged edges move corners and hide none.
    """
    if not (defects.missing_ink or defects.splashes):
        return np.ones(pattern.shape.corners, np.bool_)
    blobs = replace(defects, ragged_edge=0.0)
    off = np.array([(x, y) for x in (-1, 1) for y in (-1, 1)]) * BESIDE_CORNER * pattern.pitch
    beside = pattern.corners()[:, :, None, :2] + off
    printed = Checkerboard(pattern, blobs, seed).grey(beside)
    return np.asarray((printed == Checkerboard(pattern).grey(beside)).sum(axis=-1) >= 3)


def _pixel(
    corners: NDArray[np.float64], shape: tuple[int, ...]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The pixels of corners, (0, 0) where there is none."""
    q = np.rint(np.nan_to_num(corners)).clip(0, np.array(shape[1::-1]) - 1).astype(np.intp)
    return q[..., 0], q[..., 1]
