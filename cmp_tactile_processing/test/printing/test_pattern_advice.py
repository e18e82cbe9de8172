"""Advice on the pattern: sides are those in the image, and the advice keeps what it promises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.printing.pattern import (
    LEAST_PITCH_OVER_SKIN,
    LEAST_SIDE_PX,
    RECOMMENDED_SIDE_PX,
    PatternAdvice,
    advise,
    checker_sides_px,
    code_advice,
)
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import Camera, ImageSize, Optics, Roi, ViewDescription

DISTANCE_M = 0.03


def straight_on(focal_px: float, size_px: int = 2000) -> SensorDescription:
    """One camera straight above a flat print: a checker is focal * pitch / distance px wide."""
    sensor = load_sensor("prototype")
    T = np.eye(4)
    T[2, 3] = DISTANCE_M
    middle = (size_px - 1) / 2
    camera = Camera("pinhole", focal_px, focal_px, middle, middle, (0.0,) * 5)
    view = ViewDescription(Roi(0, 0, size_px, size_px), camera=camera, T_view_gel=T)
    flat = replace(sensor.pattern, surface=replace(sensor.pattern.surface, type="plane"))
    optics = Optics("two_view", None, ())
    image, views = ImageSize(size_px, size_px), {"left": view}
    bare = replace(sensor, image=image, camera=None, optics=optics, views=views, pattern=flat)
    return with_skin(bare, 0.0)


def with_skin(sensor: SensorDescription, thickness: float) -> SensorDescription:
    layer = replace(sensor.elastomer.shading_layer, thickness=thickness)
    return replace(sensor, elastomer=replace(sensor.elastomer, shading_layer=layer))


def with_pattern(sensor: SensorDescription, advice: PatternAdvice) -> SensorDescription:
    pattern = replace(sensor.pattern, rows=advice.rows, cols=advice.cols, pitch=advice.pitch)
    return replace(sensor, pattern=pattern)


def least_side(sensor: SensorDescription) -> float:
    return min(float(sides.min()) for sides in checker_sides_px(sensor).values())


def test_sides_are_focal_length_times_pitch_over_distance() -> None:
    """A side taken along the gel, over two checkers or of one axis alone would be off."""
    sensor = straight_on(800.0)
    sides = checker_sides_px(sensor)["left"]
    rows, cols = sensor.pattern.rows, sensor.pattern.cols
    assert sides.shape == (rows * (cols - 1) + (rows - 1) * cols,)
    np.testing.assert_allclose(sides, 800.0 * sensor.pattern.pitch / DISTANCE_M, rtol=1e-9)


@pytest.mark.parametrize("sensor", ["prototype", "sample_rig"])
def test_one_checker_more_would_be_below_what_is_recommended(sensor: str) -> None:
    """The advised pattern is the finest one whose smallest checker is large enough."""
    description = with_skin(load_sensor(sensor), 0.0)
    advice = advise(description)
    assert least_side(with_pattern(description, advice)) == pytest.approx(advice.least_side_px)
    assert advice.least_side_px >= RECOMMENDED_SIDE_PX
    size = (description.pattern.cols + 1) * description.pattern.pitch
    assert (advice.cols + 1) * advice.pitch == pytest.approx(size)
    finer = replace(
        advice, rows=advice.rows + 1, cols=advice.cols + 1, pitch=size / (advice.cols + 2)
    )
    assert least_side(with_pattern(description, finer)) < RECOMMENDED_SIDE_PX


def test_an_oblong_print_keeps_its_shape_and_square_checkers() -> None:
    """Rows and columns share the pitch; the print grows in neither direction."""
    sensor = straight_on(1000.0)
    pattern = replace(sensor.pattern, rows=11, cols=23)
    advice = advise(replace(sensor, pattern=pattern))
    assert (advice.cols + 1) * advice.pitch == pytest.approx(24 * pattern.pitch)
    assert (advice.rows + 1) * advice.pitch <= 12 * pattern.pitch * (1 + 1e-9)
    assert (advice.rows + 2) * advice.pitch > 12 * pattern.pitch


def test_no_finer_pitch_than_the_skin_lets_through() -> None:
    """A camera that sees smaller checkers well gets those of the skin, and the reason says so."""
    sensor = with_skin(straight_on(2000.0), 0.0005)
    advice = advise(sensor)
    size = (sensor.pattern.cols + 1) * sensor.pattern.pitch
    finest = LEAST_PITCH_OVER_SKIN * 0.0005
    assert advice.pitch >= finest > size / (advice.cols + 2)
    assert "skin" in advice.reason
    assert "skin" not in advise(with_skin(sensor, 0.0)).reason


@pytest.mark.parametrize(
    ("focal", "corners", "words"),
    [(4.0 * LEAST_SIDE_PX, 4, "too few pixels"), (20000.0, 60, "the largest allowed number")],
)
def test_limits_of_a_pattern_are_named(focal: float, corners: int, words: str) -> None:
    """A camera too coarse for any pattern, and one too fine, get an answer that says so."""
    sensor = straight_on(focal, 16000)
    advice = advise(sensor)
    assert advice.rows == advice.cols == corners
    assert words in advice.reason


@pytest.mark.parametrize(
    ("rows", "expected"),
    [(43, "cannot be read"), (22, "less exact"), (20, "as exact as without")],
)
def test_what_dots_are_worth_goes_with_the_checkers_in_the_image(rows: int, expected: str) -> None:
    rig = load_sensor("sample_rig")
    pitch = rig.pattern.pitch * 21 / (rows + 1)
    pattern = replace(rig.pattern, rows=rows, cols=rows, pitch=pitch, code="dots")
    assert expected in code_advice(replace(rig, pattern=pattern))
