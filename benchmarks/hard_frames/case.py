"""Frames of a pattern deformed by hand, with everything that makes tracking hard, and truth.

They are for tests of trackers: exact, made in a tenth of a second, without mechanics.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.measured import Grid, SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import Pattern, PatternSurface
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import (
    HOUSING_GREY,
    LIGHT_GREY,
    Checkerboard,
    PrintDefects,
)
from cmp_tactile_simulation.rendering.random_streams import Purpose, random_stream
from cmp_tactile_simulation.rendering.renderer import OpticalTruth, RenderedFrame, Renderer
from cmp_tactile_simulation.rendering.surface import DeformedSurface

# The displacement is known on points so many to a zone's radius: its spline follows it well.
POINTS_PER_RADIUS = 4.0
POINT_COUNTS = 24, 320
# Extent of the sample rig's pattern, m: the library's lengths hold for it and scale with others.
LIBRARY_EXTENT = 0.0145


@dataclass(frozen=True)
class Zone:
    """A round part of the gel that moves: by exp(-(distance / radius)^power) of what is given.

    x, y: its centre, gel frame.  shift: along x and y.  turn: about the centre.
    spread: share by which lengths grow there.  All lengths in m, angles in rad.
    """

    x: float = 0.0
    y: float = 0.0
    radius: float = 3e-3
    depth: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0
    spread: float = 0.0
    power: float = 2.0

    def displacement(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement (..., 3) m of the points that lay at (x, y) m at rest."""
        dx, dy = x - self.x, y - self.y
        share = np.exp(-((np.hypot(dx, dy) / self.radius) ** self.power))
        cosine, sine = np.cos(self.turn * share), np.sin(self.turn * share)
        grown = 1 + self.spread * share
        along_x = grown * (cosine * dx - sine * dy) - dx + share * self.shift[0]
        along_y = grown * (sine * dx + cosine * dy) - dy + share * self.shift[1]
        return np.stack([along_x, along_y, -self.depth * share], axis=-1)


Deformation = tuple[Zone, ...]


def deform(sensor: SensorDescription, zones: Deformation) -> DeformedSurface:
    """The sensor's marker surface with these zones moved, each as if it were alone."""
    if not zones:
        return DeformedSurface.rest(sensor.pattern)
    extent = sensor.elastomer.size[:2]
    step = min(zone.radius for zone in zones) / POINTS_PER_RADIUS
    cols, rows = (int(np.clip(np.ceil(side / step), *POINT_COUNTS)) + 1 for side in extent)
    grid = SurfaceGrid(rows, cols, extent)
    y, x = np.meshgrid(grid.y, grid.x, indexing="ij")
    moved = np.zeros((rows, cols, 3))
    for zone in zones:
        moved += zone.displacement(x, y)
    return DeformedSurface(sensor.pattern, grid, moved)


def _rest(pattern: Pattern, rng: np.random.Generator) -> Deformation:  # noqa: ARG001
    return ()


def _press(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    x, y = rng.uniform(-0.1, 0.1, 2) * LIBRARY_EXTENT
    return _scaled(pattern, Zone(x, y, 3.6e-3, depth=9e-4, spread=0.09))


def _slide(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(6e-4, 9e-4)
    x, y = rng.uniform(-0.1, 0.1, 2) * LIBRARY_EXTENT
    shift = length * np.cos(angle), length * np.sin(angle)
    press, drag = Zone(x, y, 4e-3, depth=1.1e-3), Zone(x, y, 6.5e-3, shift=shift)
    return _scaled(pattern, press, drag)


def _twist(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    x, y = rng.uniform(-0.1, 0.1, 2) * LIBRARY_EXTENT
    turn = rng.choice([-1, 1]) * rng.uniform(0.14, 0.2)
    press, turned = Zone(x, y, 3.5e-3, depth=7e-4), Zone(x, y, 5e-3, turn=turn)
    return _scaled(pattern, press, turned)


def _bumps(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    places = rng.uniform(-0.3, 0.3, (5, 2)) * LIBRARY_EXTENT
    zones = [
        Zone(x, y, rng.uniform(9e-4, 1.6e-3), depth=rng.uniform(1.5e-4, 3.5e-4), spread=0.06)
        for x, y in places
    ]
    return _scaled(pattern, *zones)


def _spheres(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    """Small spheres, each touching in the middle of a checker's side or of a checker."""
    rows = rng.permutation(pattern.rows - 1)[: max(1, min(12, pattern.rows // 2))]
    zones = []
    for row in rows:
        col = rng.integers(pattern.cols - 1)
        at_row, at_col = [(0.0, 0.5), (0.5, 0.0), (0.5, 0.5)][rng.integers(3)]
        x = (col + at_col - (pattern.cols - 1) / 2) * pattern.pitch
        y = (row + at_row - (pattern.rows - 1) / 2) * pattern.pitch
        radius = rng.uniform(0.5, 0.8) * pattern.pitch
        zones.append(Zone(x, y, radius, depth=rng.uniform(0.16, 0.28) * radius, spread=0.05))
    return tuple(zones)


def _drag(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    angle = rng.uniform(0, 2 * np.pi)
    shift = 6e-4 * np.cos(angle), 6e-4 * np.sin(angle)
    press, drag = Zone(0, 0, 4.5e-3, depth=1e-3, spread=0.08), Zone(0, 0, 8e-3, shift=shift)
    return _scaled(pattern, press, drag)


def _knock(pattern: Pattern, rng: np.random.Generator) -> Deformation:
    """Moved by more than two checkers, unless they are large, and nearly as a whole."""
    # Not further than a gel can be dragged.
    angle, length = rng.uniform(0, 2 * np.pi), float(np.clip(2.2 * pattern.pitch, 1.5e-3, 2.4e-3))
    shift = length * np.cos(angle), length * np.sin(angle)
    (press,) = _scaled(pattern, Zone(0, 0, 4.5e-3, depth=1e-3, spread=0.05))
    (drag,) = _scaled(pattern, Zone(0, 0, 9e-3, power=4))
    return press, Zone(0, 0, drag.radius, shift=shift, power=4)


def _scaled(pattern: Pattern, *zones: Zone) -> Deformation:
    scale = max(pattern.rows + 1, pattern.cols + 1) * pattern.pitch / LIBRARY_EXTENT
    return tuple(
        Zone(
            zone.x * scale,
            zone.y * scale,
            zone.radius * scale,
            zone.depth * scale,
            (zone.shift[0] * scale, zone.shift[1] * scale),
            zone.turn,
            zone.spread,
            zone.power,
        )
        for zone in zones
    )


DEFORMATIONS: dict[str, Callable[[Pattern, np.random.Generator], Deformation]] = {
    "rest": _rest,
    "press": _press,
    "slide": _slide,
    "twist": _twist,
    "bumps": _bumps,
    "spheres": _spheres,
    "drag": _drag,
    "knock": _knock,
}


def deformation_of(kind: str, pattern: Pattern, seed: int = 0) -> Deformation:
    """Zones of that kind, of a size that suits the pattern, at places set by the seed.

    Raises ParameterError for a kind that is not in DEFORMATIONS.
    """
    if kind not in DEFORMATIONS:
        msg = f"deformation: found {kind!r}, expected one of {', '.join(DEFORMATIONS)}"
        raise ParameterError(msg)
    return DEFORMATIONS[kind](pattern, np.random.default_rng([len(kind), seed]))


# What a camera sees around the gel: parts of the housing, lamps.

# Sides of a part and spread of a lamp's light, px of the frame; light of a lamp, grey levels.
PART_SIDES = (20.0, 130.0), (8.0, 45.0)
LAMP_SPREAD = (5.0, 9.0)
LAMP_LIGHT = 600.0
PART_GREYS = (5.0, 245.0)
# The housing is the darkest of what is rendered; a rim of it is mixed with the skin.
RIM = 1.0


@dataclass(frozen=True)
class Scenery:
    """Number of flat parts on the housing next to the skin, and of lamps there."""

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
        ink = Checkerboard(case.sensor.sheet, case.defects, case.seed, case.margin)
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
