"""Frames of a pattern deformed by hand, with everything that makes tracking hard, and truth.

They are for tests of trackers: exact, made in a tenth of a second, without mechanics.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import Pattern, PatternSurface
from cmp_tactile_simulation.rendering import Purpose, random_stream
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import LIGHT_GREY, Checkerboard, PrintDefects
from cmp_tactile_simulation.rendering.renderer import OpticalTruth, RenderedFrame, Renderer
from hard_frames.covers import Cover, Scenery, cover_views, far_corners, pixels_of
from hard_frames.deformation import EXTENT, Deformation, deform, deformation_of

Flags = NDArray[np.bool_]

# A corner in the middle of so many pixels that are all white shows nothing.
BLOWN_OUT_PX, WHITE = 5, 254
# The checkers that meet at a corner are looked at this share of a side from it, along x and y.
BESIDE_CORNER = 0.15
# With less between light and dark, grey levels, nothing is visible.
LEAST_CONTRAST = 3.0
KEPT_RENDERERS = 4


def pattern_rig(
    rows: int = 20,
    cols: int = 20,
    *,
    corner_checker: str = "dark",
    surface: PatternSurface | None = None,
    points_per_segment: int = 6,
) -> SensorDescription:
    """The sample rig with another pattern of the same extent, 14.5 mm along its longer side.

    surface: default that of the rig.
    """
    sensor = load_sensor("sample_rig")
    pattern = replace(
        sensor.pattern,
        rows=rows,
        cols=cols,
        pitch=EXTENT / (max(rows, cols) + 1),
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


def bent(sensor: SensorDescription, kind: str, seed: int = 0, **changes: Any) -> PatternCase:
    """A case with a deformation of that kind, named after it; changes: of the other fields."""
    zones = deformation_of(kind, sensor.pattern, seed)
    return replace(PatternCase(f"{kind} {seed}", sensor, zones, seed=seed), **changes)


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
    visible: Mapping[str, Flags]
    far: Mapping[str, Flags]


class PatternStudio:
    """Makes frames of cases; keeps what cases of the same sensor and print share.

    samples: of a pixel, along each side.
    """

    def __init__(self, samples: int = 4) -> None:
        self._samples = samples
        self._renderers: list[tuple[SensorDescription, Checkerboard, Renderer]] = []
        self._truths: list[tuple[SensorDescription, OpticalTruth]] = []

    def photograph(self, case: PatternCase) -> PatternFrame:
        """The frame of a case.  Raises InputError for a sensor without a block."""
        surface = deform(case.sensor, case.deformation)
        rendered = self._renderer(case).render(surface)
        scenery_rng = random_stream(Purpose.SCENERY, case.seed)
        grey = case.scenery.paint(rendered.grey, rendered.fineness, scenery_rng)
        truth = self._truth(case.sensor).grids(surface)
        shown = _printed(case.sensor.pattern, case.defects, case.seed)
        shown &= case.camera.light_level - case.camera.dark_level >= LEAST_CONTRAST
        visible = dict.fromkeys(truth, shown)
        return _exposed(case, replace(rendered, grey=grey), truth, (visible, visible))

    def _renderer(self, case: PatternCase) -> Renderer:
        ink = Checkerboard(case.sensor.sheet, case.defects, case.seed, case.margin)
        for sensor, known, renderer in self._renderers:
            if sensor is case.sensor and known == ink:
                return renderer
        renderer = Renderer(case.sensor, ink, self._samples)
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
    case = PatternCase(frame.name, frame.sensor, camera=camera, cover=cover, seed=seed)
    rendered = RenderedFrame(frame.image.astype(np.float32), 1)
    return _exposed(case, rendered, frame.truth, (frame.visible, frame.far))


def _exposed(
    case: PatternCase,
    rendered: RenderedFrame,
    truth: Mapping[str, Grid],
    shown: tuple[Mapping[str, Flags], Mapping[str, Flags]],
) -> PatternFrame:
    """What is rendered, behind the cover, through the camera; shown: visible and far without."""
    covered = {name: np.zeros((0, 0), np.bool_) for name in truth}
    if case.cover is not None:
        cover_rng = random_stream(Purpose.COVER, case.seed)
        rendered, covered = cover_views(rendered, truth, case.cover, cover_rng)
    noise = random_stream(Purpose.FRAME_NOISE, case.seed, case.frame)
    image = expose(rendered, case.camera, noise, case.seed)
    visible, far = {}, {}
    for name, grid in truth.items():
        visible[name] = shown[0][name] & _visible(image, grid, covered[name])
        far[name] = shown[1][name] & visible[name] & far_corners(grid.corners, covered[name])
    return PatternFrame(case.name, case.sensor, image, truth, visible, far)


def _visible(image: NDArray[np.uint8], grid: Grid, covered: Flags) -> Flags:
    visible = np.isfinite(grid.corners[..., 0])
    if covered.any():
        x, y = pixels_of(grid.corners, covered.shape)
        visible &= ~covered[y, x]
    darkest = cv2.erode(image, np.ones((BLOWN_OUT_PX, BLOWN_OUT_PX), np.uint8))
    x, y = pixels_of(grid.corners_frame, image.shape)
    return np.asarray(visible & (darkest[y, x] < WHITE))


def _printed(pattern: Pattern, defects: PrintDefects, seed: int) -> Flags:
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


def disc(radius: float) -> NDArray[np.float64]:
    """The image of a point out of focus, (n, n): a disc with a soft rim of one pixel."""
    reach = int(np.ceil(radius)) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray((radius + 0.5 - np.hypot(x, y)).clip(0.0, 1.0))


def streak(length: float, angle: float) -> NDArray[np.float64]:
    """The image of a point that moves by so many px in that direction, rad; (n, n)."""
    reach = int(np.ceil(length / 2)) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    along = np.abs(x * np.cos(angle) + y * np.sin(angle))
    across = np.abs(y * np.cos(angle) - x * np.sin(angle))
    return np.asarray((length / 2 + 0.5 - along).clip(0, 1) * (1.0 - across).clip(0, 1))
