"""Kinds of hard frames: lists and sequences of cases for any rig, bad images, sample data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import Grid, GridShape, Status, ViewPlacement
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.ink import PrintDefects
from hard_frames.covers import COVERS, Cover, Scenery
from hard_frames.deformation import (
    DEFORMATIONS,
    DEPTH,
    DRAGGED,
    PRESSED,
    SHIFTED,
    Deformation,
    Zone,
    jump,
)
from hard_frames.studio import PatternCase, PatternFrame, bent, pattern_rig

GREY_MARGIN = 125.0
# Lengths over which flaws of a worn print are alike, and the mean radius of its blobs, m.
RAGGED_LENGTH, BLOB_RADIUS = 2.2e-4, 1.2e-4
# Shares of the pattern that shapes hide, where it is not a third.
COVER_SHARES = {"left_top": 0.25, "right_bottom": 0.25, "band_across": 0.2, "band_down": 0.2}
COVER_GREYS = (15.0, 110.0, 200.0)
TEXTURE = 35.0
RIGS: tuple[tuple[int, int, str, PatternSurface], ...] = (
    (4, 4, "dark", PatternSurface()),
    (5, 8, "light", PatternSurface("sphere_cap", 0.027)),
    (9, 14, "dark", PatternSurface("cylinder", 0.02, "x")),
    (14, 9, "light", PatternSurface("cylinder", 0.03, "y")),
    (20, 20, "light", PatternSurface("sphere_cap", 0.027)),
    (30, 30, "dark", PatternSurface()),
    (24, 40, "light", PatternSurface("sphere_cap", 0.04)),
    (60, 60, "dark", PatternSurface("sphere_cap", 0.027)),
)
KNOCKED = ("knock", "slide", "press", "twist")
Cases = list[PatternCase]


def _clean(sensor: SensorDescription, seed: int) -> Cases:
    return [bent(sensor, kind, seed) for kind in DEFORMATIONS if kind != "spheres"]


def _spheres(sensor: SensorDescription, seed: int) -> Cases:
    return [bent(sensor, "spheres", seed)]


def _with(**changes: Any) -> Callable[[SensorDescription, int], Cases]:
    """A gel at rest and a knocked one, with these fields changed."""

    def cases(sensor: SensorDescription, seed: int) -> Cases:
        kinds = "rest", KNOCKED[seed % len(KNOCKED)]
        return [bent(sensor, kind, seed, **changes) for kind in kinds]

    return cases


def _seen_by(**camera: float) -> Callable[[SensorDescription, int], Cases]:
    return _with(camera=CameraSettings(**camera))  # type: ignore[arg-type]


def _cluttered(sensor: SensorDescription, seed: int) -> Cases:
    scenery = Scenery(parts=14, lamps=3)
    return [
        bent(sensor, kind, seed, scenery=scenery, margin=margin)
        for kind, margin in (("slide", 205.0), ("press", GREY_MARGIN), ("knock", 60.0))
    ]


def _dirty(sensor: SensorDescription, seed: int) -> Cases:
    camera = CameraSettings(clutter=12, glare_spots=2, glare_size=5.0, glare_strength=300.0)
    return [bent(sensor, kind, seed, camera=camera) for kind in ("slide", "bumps")]


def _hidden(sensor: SensorDescription, seed: int) -> Cases:
    rng = np.random.default_rng(seed)
    cases = []
    for number, shape in enumerate(COVERS):
        grey = COVER_GREYS[(seed + number) % len(COVER_GREYS)]
        texture = TEXTURE if rng.random() < 0.5 else 0.0
        cover = Cover(shape, COVER_SHARES.get(shape, 1 / 3), grey, texture)
        kind = ("rest", "press", "slide", "twist")[(seed + number) % 4]
        name = f"hidden {shape} {grey:g}/{texture:g} {kind} {seed}"
        cases.append(bent(sensor, kind, seed, name=name, cover=cover))
    return cases


def _all_at_once(sensor: SensorDescription, seed: int) -> Cases:
    camera = CameraSettings(
        blur=1.3, read_noise=3.0, light_ratio=2.5, vignette=0.4, salt_and_pepper=2e-3, clutter=5
    )
    defects = PrintDefects(20, 10, BLOB_RADIUS, 1.5e-5, RAGGED_LENGTH)
    kind, scenery = KNOCKED[seed % len(KNOCKED)], Scenery(parts=10, lamps=2)
    return [bent(sensor, kind, seed, camera=camera, defects=defects, scenery=scenery)]


def _other_rigs(sensor: SensorDescription, seed: int) -> Cases:  # noqa: ARG001
    cases = []
    for number, (rows, cols, corner, surface) in enumerate(RIGS):
        rig = pattern_rig(rows, cols, corner_checker=corner, surface=surface)
        kind = ("slide", "press", "twist")[(seed + number) % 3]
        name = f"{rows} x {cols} {corner} {surface.type} {kind} {seed}"
        cases.append(bent(rig, kind, seed, name=name))
    return cases


CASE_KINDS: dict[str, Callable[[SensorDescription, int], Cases]] = {
    "clean": _clean,
    "small spheres": _spheres,
    "blur 2": _seen_by(blur=2.0),
    "blur 3": _seen_by(blur=3.0),
    "blur 4": _seen_by(blur=4.0),
    "noise 4": _seen_by(read_noise=4.0),
    "noise 8": _seen_by(read_noise=8.0),
    "noise 16": _seen_by(read_noise=16.0),
    "salt and pepper 1 %": _seen_by(salt_and_pepper=0.01),
    "salt and pepper 10 %": _seen_by(salt_and_pepper=0.1),
    "light 0.35": _seen_by(light_ratio=1 / 0.35, vignette=0.4),
    "light 0.2": _seen_by(light_ratio=5.0, vignette=0.4),
    "low contrast": _seen_by(light_level=85.0, dark_level=55.0),
    "dark": _seen_by(light_level=40.0, dark_level=9.0),
    "missing ink 40": _with(defects=PrintDefects(40, 0, BLOB_RADIUS)),
    "blobs 40": _with(defects=PrintDefects(20, 20, BLOB_RADIUS)),
    "ragged 0.015 mm": _with(defects=PrintDefects(0, 0, BLOB_RADIUS, 1.5e-5, RAGGED_LENGTH)),
    "ragged 0.06 mm": _with(defects=PrintDefects(0, 0, BLOB_RADIUS, 6e-5, RAGGED_LENGTH)),
    "clutter, glare, margin": _cluttered,
    "dirt on the optics": _dirty,
    "hidden": _hidden,
    "all at once": _all_at_once,
    "other rigs": _other_rigs,
}


def cases_of(kind: str, sensor: SensorDescription, seed: int = 0) -> Cases:
    """The cases of that kind; cases of "other rigs" have other sensors."""
    return CASE_KINDS[kind](sensor, seed)


def flawed_pairs(sensor: SensorDescription, seed: int = 0) -> list[tuple[PatternCase, PatternCase]]:
    """Pairs of one flawed print at rest and deformed: judged by displacement."""
    camera = CameraSettings(blur=1.1, read_noise=2.5, light_ratio=1.67, vignette=0.3)
    prints = (
        PrintDefects(20, 10, BLOB_RADIUS, 1.5e-5, RAGGED_LENGTH),
        PrintDefects(40, 0, BLOB_RADIUS),
        PrintDefects(0, 0, BLOB_RADIUS, 6e-5, RAGGED_LENGTH),
    )
    return [
        (
            bent(sensor, "rest", seed, camera=camera, defects=defects),
            bent(sensor, kind, seed, camera=camera, defects=defects, frame=1),
        )
        for kind, defects in zip(("slide", "slide", "press"), prints, strict=True)
    ]


# Sequences of frames of patterns deformed by hand: what a tracker that follows must survive.

KNOCK = 1.5e-3
FARTHEST_SHIFT = 2


def _numbered(sensor: SensorDescription, name: str, steps: list[Deformation], seed: int) -> Cases:
    return [
        PatternCase(f"{name} {frame}", sensor, zones, seed=seed, frame=frame)
        for frame, zones in enumerate(steps)
    ]


def _grasp(sensor: SensorDescription, seed: int) -> Cases:
    """At rest, pressed, dragged, knocked, held, knocked back, released step by step, at rest."""
    way = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    ahead = np.array([np.cos(way), np.sin(way)])
    steps: list[Deformation] = [(), ()]
    steps += [(_pressed(share),) for share in np.linspace(0.1, 1, 10)]
    drags = [(share * 7e-4, 0.0) for share in np.linspace(0.1, 1, 8)]
    drags += 4 * [(7e-4, KNOCK)] + 2 * [(7e-4, 0.0)]
    for drag, knock in drags:
        moved = Zone(radius=DRAGGED, shift=tuple(drag * ahead))
        knocked = Zone(radius=SHIFTED, shift=tuple(-knock * ahead), power=4)
        steps.append((_pressed(1.0), moved, knocked))
    steps += [(_pressed(share),) for share in (0.6, 0.2)]
    return _numbered(sensor, "grasp", [*steps, ()], seed)


def _pressed(share: float) -> Zone:
    return Zone(radius=PRESSED, depth=share * DEPTH, spread=0.08 * share)


def _released(sensor: SensorDescription, seed: int) -> Cases:
    """A knocked and pressed gel that is at rest one frame later, thrice."""
    rng = np.random.default_rng(seed)
    steps: list[Deformation] = [()]
    for _ in range(3):
        way, length = rng.uniform(0, 2 * np.pi), rng.uniform(1.2, 2.4)
        held = jump(sensor, (length * np.cos(way), length * np.sin(way)))
        steps += [held, held, (), ()]
    return _numbered(sensor, "released", steps, seed)


def _shifted(sensor: SensorDescription, seed: int) -> Cases:
    """Shifts by whole checkers in all directions, each from rest: the lattice looks the same."""
    reach = range(-FARTHEST_SHIFT, FARTHEST_SHIFT + 1)
    steps: list[Deformation] = []
    for right in reach:
        for up in reach:
            steps += [(), jump(sensor, (float(right), float(up)))]
    return _numbered(sensor, "shifted", steps, seed)


def _hidden_for_a_while(sensor: SensorDescription, seed: int) -> Cases:
    """A cover that comes from the left and goes back, over a gel that moves meanwhile."""
    shares = [0.0, 0.15, 0.3, 0.45, 0.6, 0.45, 0.3, 0.15, 0.0]
    steps = [jump(sensor, (0.15 * number, 0.0)) for number in range(len(shares))]
    return [
        replace(case, cover=Cover("left", share, 60.0) if share else None)
        for case, share in zip(_numbered(sensor, "hidden", steps, seed), shares, strict=True)
    ]


def _light_switched(sensor: SensorDescription, seed: int) -> Cases:
    """Light that goes off, comes back brighter, and dims, while the gel is knocked in the dark."""
    lights = [1.0, 1.0, 0.005, 0.005, 1.2, 1.2, 0.4, 0.4, 1.0]
    shifts = [0.0, 0.0, 0.0, 2.0, 2.0, 2.0, 2.0, 0.0, 0.0]
    steps = [jump(sensor, (shift, 0.0)) for shift in shifts]
    return [
        replace(case, camera=CameraSettings(light_level=205 * light, dark_level=45 * light))
        for case, light in zip(_numbered(sensor, "light", steps, seed), lights, strict=True)
    ]


SEQUENCES: dict[str, Callable[[SensorDescription, int], Cases]] = {
    "grasp": _grasp,
    "released": _released,
    "shifted": _shifted,
    "hidden for a while": _hidden_for_a_while,
    "light switched": _light_switched,
}


def sequence_of(kind: str, sensor: SensorDescription, seed: int = 0) -> Cases:
    """The frames of that sequence, in order; lengths suit a pattern of about 14.5 mm."""
    return SEQUENCES[kind](sensor, seed)


# View images in which no grid may be found: the sensor is not the one that is described.


def bad_views(view: NDArray[np.uint8], seed: int = 0) -> Mapping[str, NDArray[np.uint8]]:
    """Images of the size of a good view image, (height, width), that show no pattern as it is.

    "two patterns" shows the good one twice and smaller; "mirrored" what a wrong flip gives.
    """
    rng = np.random.default_rng(seed)
    height, width = view.shape
    small = view[::2, ::2]
    twice = np.full_like(view, int(np.median(view)))
    twice[: small.shape[0], : small.shape[1]] = small
    twice[height - small.shape[0] :, width - small.shape[1] :] = small
    stripes = np.indices(view.shape)[1] // 12 % 2 * 160 + 45
    return {
        "black": np.zeros_like(view),
        "white": np.full_like(view, 255),
        "grey": np.full_like(view, 128),
        "saturated": np.minimum(view.astype(np.int64) * 20 + 250, 255).astype(np.uint8),
        "noise": rng.integers(0, 256, view.shape).astype(np.uint8),
        "stripes": stripes.astype(np.uint8),
        "mirrored": np.ascontiguousarray(view[:, ::-1]),
        "upside down": np.ascontiguousarray(view[::-1]),
        "turned": np.ascontiguousarray(view[::-1, ::-1]),
        "inverted": 255 - view,
        "two patterns": twice,
    }


def misdescribed(sensor: SensorDescription) -> Mapping[str, SensorDescription]:
    """Descriptions of the same rig with a pattern of another size or the other colours."""
    pattern = sensor.pattern
    rows, cols = pattern.rows, pattern.cols
    sizes = (rows - 1, cols), (rows, cols - 2), (rows - 2, cols - 2), (rows + 1, cols + 1)
    other = "light" if pattern.corner_checker == "dark" else "dark"
    changes: dict[str, dict[str, Any]] = {
        f"{i} x {j} expected": {"rows": i, "cols": j} for i, j in (*sizes, (rows + 2, cols))
    }
    changes["other colours expected"] = {"corner_checker": other}
    return {
        name: replace(sensor, pattern=replace(pattern, **change))
        for name, change in changes.items()
    }


# Frames with truth from a folder of PNG and NPZ files, as an independent renderer writes them. The
# folder holds sensor.yaml and, in subfolders, NAME.png with NAME.npz: corners_VIEW_px (rows, cols,
# 2), row_lines_VIEW_px (rows, points, 2) and col_lines_VIEW_px (cols, points, 2) in px of the whole
# frame, where the corners of each line have the same number of points between them.


def sample_names(folder: Path, kind: str) -> list[str]:
    """Names of the frames in a subfolder of it, in order: "still/rest", ..."""
    return [f"{kind}/{path.stem}" for path in sorted((folder / kind).glob("*.npz"))]


def load_sample(sensor: SensorDescription, folder: Path, name: str) -> PatternFrame:
    """The frame of that name; FrameError where its image or truth cannot be read."""
    image = cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
    if image is None:
        msg = f"{folder / name}.png: found no readable image, expected a grey PNG"
        raise FrameError(msg)
    with np.load(folder / f"{name}.npz", allow_pickle=False) as arrays:
        truth = {
            view: _grid(sensor.pattern.shape, arrays, view, geometry.placement)
            for view, geometry in build_views(sensor).items()
        }
    visible = {view: np.isfinite(grid.corners[..., 0]) for view, grid in truth.items()}
    return PatternFrame(name, sensor, np.asarray(image, np.uint8), truth, visible, visible)


def _grid(
    shape: GridShape, arrays: dict[str, NDArray[np.float64]], view: str, place: ViewPlacement
) -> Grid:
    corners, rows, cols = (
        place.from_frame(arrays[f"{key}_{view}_px"])
        for key in ("corners", "row_lines", "col_lines")
    )
    row_lines, col_lines = _between(rows, shape.cols), _between(cols, shape.rows).swapaxes(0, 1)
    grid = Grid.missing(replace(shape, points_per_segment=row_lines.shape[2]), "", place)
    return replace(
        grid,
        corners=corners,
        corner_status=np.full_like(grid.corner_status, Status.MEASURED),
        row_lines=row_lines,
        row_line_status=np.full_like(grid.row_line_status, Status.MEASURED),
        col_lines=np.ascontiguousarray(col_lines),
        col_line_status=np.full_like(grid.col_line_status, Status.MEASURED),
    )


def _between(lines: NDArray[np.float64], corners: int) -> NDArray[np.float64]:
    """Points between the corners, (n, corners - 1, k, 2), of lines (n, points, 2)."""
    step = (lines.shape[1] - 1) // (corners - 1)
    return lines[:, :-1].reshape(len(lines), corners - 1, step, 2)[:, :, 1:]
