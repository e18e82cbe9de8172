"""Kinds of hard frames: each a list of cases, made for any rig."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.pattern import PatternSurface
from cmp_tactile_simulation.hard_frames.case import PatternCase, pattern_rig
from cmp_tactile_simulation.hard_frames.cover import COVERS, Cover
from cmp_tactile_simulation.hard_frames.deformation import DEFORMATIONS, deformation_of
from cmp_tactile_simulation.hard_frames.scenery import Scenery
from cmp_tactile_simulation.rendering.camera_settings import CameraSettings
from cmp_tactile_simulation.rendering.print_defects import PrintDefects

__all__ = ["CASE_KINDS", "cases_of", "flawed_pairs"]

CLEAN = CameraSettings()
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


def _bent(sensor: SensorDescription, name: str, kind: str, seed: int) -> PatternCase:
    zones = deformation_of(kind, sensor.pattern, seed)
    return PatternCase(f"{name} {kind} {seed}", sensor, zones, seed=seed)


def _clean(sensor: SensorDescription, seed: int) -> Cases:
    return [_bent(sensor, "clean", kind, seed) for kind in DEFORMATIONS if kind != "spheres"]


def _spheres(sensor: SensorDescription, seed: int) -> Cases:
    return [_bent(sensor, "clean", "spheres", seed)]


def _seen_by(camera: CameraSettings) -> Callable[[SensorDescription, int], Cases]:
    def cases(sensor: SensorDescription, seed: int) -> Cases:
        return [
            replace(_bent(sensor, "seen", kind, seed), camera=camera)
            for kind in ("rest", KNOCKED[seed % len(KNOCKED)])
        ]

    return cases


def _printed(defects: PrintDefects) -> Callable[[SensorDescription, int], Cases]:
    def cases(sensor: SensorDescription, seed: int) -> Cases:
        return [
            replace(_bent(sensor, "printed", kind, seed), defects=defects)
            for kind in ("rest", KNOCKED[seed % len(KNOCKED)])
        ]

    return cases


def _cluttered(sensor: SensorDescription, seed: int) -> Cases:
    scenery = Scenery(parts=14, lamps=3)
    return [
        replace(_bent(sensor, "cluttered", kind, seed), scenery=scenery, margin=margin)
        for kind, margin in (("slide", 205.0), ("press", GREY_MARGIN), ("knock", 60.0))
    ]


def _dirty(sensor: SensorDescription, seed: int) -> Cases:
    camera = CameraSettings(clutter=12, glare_spots=2, glare_size=5.0, glare_strength=300.0)
    return [
        replace(_bent(sensor, "dirty", kind, seed), camera=camera) for kind in ("slide", "bumps")
    ]


def _hidden(sensor: SensorDescription, seed: int) -> Cases:
    rng = np.random.default_rng(seed)
    cases = []
    for number, shape in enumerate(COVERS):
        grey = COVER_GREYS[(seed + number) % len(COVER_GREYS)]
        texture = TEXTURE if rng.random() < 0.5 else 0.0
        cover = Cover(shape, COVER_SHARES.get(shape, 1 / 3), grey, texture)
        kind = ("rest", "press", "slide", "twist")[(seed + number) % 4]
        case = _bent(sensor, f"hidden {shape} {grey:g}/{texture:g}", kind, seed)
        cases.append(replace(case, cover=cover))
    return cases


def _all_at_once(sensor: SensorDescription, seed: int) -> Cases:
    camera = CameraSettings(
        blur=1.3, read_noise=3.0, light_ratio=2.5, vignette=0.4, salt_and_pepper=2e-3, clutter=5
    )
    defects = PrintDefects(20, 10, BLOB_RADIUS, 1.5e-5, RAGGED_LENGTH)
    case = _bent(sensor, "all at once", KNOCKED[seed % len(KNOCKED)], seed)
    scenery = Scenery(parts=10, lamps=2)
    return [replace(case, camera=camera, defects=defects, scenery=scenery)]


def _other_rigs(sensor: SensorDescription, seed: int) -> Cases:  # noqa: ARG001
    cases = []
    for number, (rows, cols, corner, surface) in enumerate(RIGS):
        rig = pattern_rig(rows, cols, corner_checker=corner, surface=surface)
        kind = ("slide", "press", "twist")[(seed + number) % 3]
        name = f"{rows} x {cols} {corner} {surface.type}"
        cases.append(_bent(rig, name, kind, seed))
    return cases


CASE_KINDS: dict[str, Callable[[SensorDescription, int], Cases]] = {
    "clean": _clean,
    "small spheres": _spheres,
    "blur 2": _seen_by(replace(CLEAN, blur=2.0)),
    "blur 3": _seen_by(replace(CLEAN, blur=3.0)),
    "blur 4": _seen_by(replace(CLEAN, blur=4.0)),
    "noise 4": _seen_by(replace(CLEAN, read_noise=4.0)),
    "noise 8": _seen_by(replace(CLEAN, read_noise=8.0)),
    "noise 16": _seen_by(replace(CLEAN, read_noise=16.0)),
    "salt and pepper 1 %": _seen_by(replace(CLEAN, salt_and_pepper=0.01)),
    "salt and pepper 10 %": _seen_by(replace(CLEAN, salt_and_pepper=0.1)),
    "light 0.35": _seen_by(replace(CLEAN, light_ratio=1 / 0.35, vignette=0.4)),
    "light 0.2": _seen_by(replace(CLEAN, light_ratio=5.0, vignette=0.4)),
    "low contrast": _seen_by(replace(CLEAN, light_level=85.0, dark_level=55.0)),
    "dark": _seen_by(replace(CLEAN, light_level=40.0, dark_level=9.0)),
    "missing ink 40": _printed(PrintDefects(40, 0, BLOB_RADIUS)),
    "blobs 40": _printed(PrintDefects(20, 20, BLOB_RADIUS)),
    "ragged 0.015 mm": _printed(PrintDefects(0, 0, BLOB_RADIUS, 1.5e-5, RAGGED_LENGTH)),
    "ragged 0.06 mm": _printed(PrintDefects(0, 0, BLOB_RADIUS, 6e-5, RAGGED_LENGTH)),
    "clutter, glare, margin": _cluttered,
    "dirt on the optics": _dirty,
    "hidden": _hidden,
    "all at once": _all_at_once,
    "other rigs": _other_rigs,
}


def cases_of(kind: str, sensor: SensorDescription, seed: int = 0) -> Cases:
    """The cases of that kind; those of "other rigs" have sensors of their own."""
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
            replace(_bent(sensor, "flawed", "rest", seed), camera=camera, defects=defects),
            replace(_bent(sensor, "flawed", kind, seed), camera=camera, defects=defects, frame=1),
        )
        for kind, defects in zip(("slide", "slide", "press"), prints, strict=True)
    ]
