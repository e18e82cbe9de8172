"""The flat print: arc lengths, distances, edges, ink gain, against closed forms and integrals."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.printing.pattern import (
    PrintOptions,
    flat_print,
    inset,
    printed_pattern,
    rectangle,
    rim_strain,
)
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.sensor.parts import Pattern, PatternSurface

# Rounding of lengths of some ten mm.
ATOL_EXACT_MM = 1e-9
PLANE = PatternSurface()
CAP = PatternSurface("sphere_cap", 0.012)
CYLINDERS = (PatternSurface("cylinder", 0.009, "x"), PatternSurface("cylinder", 0.009, "y"))


@pytest.fixture(scope="module")
def rig():
    return load_sensor("sample_rig")


def sensor_of(rig, surface=PLANE, **changes):
    pattern = Pattern(5, 8, 0.0012, "dark", 3, surface)
    return replace(rig, pattern=replace(pattern, **changes))


def area(contour):
    """Positive where ink lies inside."""
    x, y = contour.T
    return (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2


def test_the_strain_is_that_of_the_circle_through_the_farthest_corner():
    corners = rectangle(0.006, 0.005)
    distance = np.hypot(0.006, 0.005)
    flat = np.hypot(*flat_print(CAP, "unrolled", corners)[0])
    expected = (2 * np.pi * distance) / (2 * np.pi * flat) - 1
    assert rim_strain(CAP, "unrolled", corners) == pytest.approx(expected, rel=1e-12)
    assert expected < -0.05
    assert rim_strain(CAP, "along_axis", corners) == 0
    assert rim_strain(CYLINDERS[0], "unrolled", corners) == 0


@pytest.mark.parametrize("colour", ["dark", "light"])
def test_ink_gain_leaves_gaps_between_checkers_and_is_undone_by_spreading(colour, rig):
    """Each edge moves by the gain, so ink that spreads by it comes out as described."""
    gain = 0.05
    sensor = sensor_of(rig, corner_checker=colour)
    checkers = printed_pattern(sensor, PrintOptions(ink_gain=gain * 1e-3)).ink
    assert len(checkers) == 27
    for contour in checkers:
        assert area(contour) == pytest.approx((1.2 - 2 * gain) ** 2, abs=ATOL_EXACT_MM)
    # Every second checker, that outside corner (0, 0) where it is to be dark.
    centres = np.array([contour.mean(axis=0) for contour in checkers])
    off = np.abs(centres - [-4 * 1.2, -2.5 * 1.2]).max(axis=1).min()
    assert (off < 1e-9) == (colour == "dark")
    options = PrintOptions(invert=True, ink_gain=gain * 1e-3)
    thin = printed_pattern(sensor, options)
    full = printed_pattern(sensor, replace(options, ink_gain=0))
    for narrow, wide in zip(thin.ink, full.ink, strict=True):
        np.testing.assert_allclose(inset(narrow, -gain), wide, atol=ATOL_EXACT_MM)
    ring, comb = full.ink[:2]
    assert area(ring) > 0 > area(comb)
    # Around the dark checkers nothing but the gain is gone: what is left is the light ones' ink.
    dark_side = 1.2 + 2 * gain
    overlaps = 5 * 8 * 2 * (2 * gain) ** 2 / 2
    ink = sum(area(contour) for contour in thin.ink)
    outside = (9 * 1.2 + 2 - 2 * gain) * (6 * 1.2 + 2 - 2 * gain)
    assert ink == pytest.approx(outside - 27 * dark_side**2 + overlaps, abs=ATOL_EXACT_MM)


def test_ink_gain_of_curved_edges_is_the_distance_on_the_flat_print(rig):
    gain = 0.04
    sensor = sensor_of(rig, CAP, pitch=0.0015)
    options = PrintOptions(process="unrolled", margin=0)
    whole = printed_pattern(sensor, options)
    assert whole.gel is None, "the block reaches beyond the sphere"
    full = whole.ink
    thin = printed_pattern(sensor, replace(options, ink_gain=gain * 1e-3)).ink
    for wide, narrow in zip(full, thin, strict=True):
        ends = np.roll(wide, -1, axis=0)
        along = (ends - wide) / np.linalg.norm(ends - wide, axis=1)[:, None]
        away = narrow[:, None] - wide[None]
        distance = np.abs(along[None, :, 0] * away[..., 1] - along[None, :, 1] * away[..., 0])
        share = (away * along[None]).sum(axis=-1) / np.linalg.norm(ends - wide, axis=1)
        distance[(share < -0.01) | (share > 1.01)] = np.inf
        assert distance.min(axis=1) == pytest.approx(gain, abs=2e-3 * gain)


def test_a_print_that_is_too_large_for_the_block_is_reported(rig):
    block = replace(rig.elastomer, size=(9 * 0.0012 + 0.002, 0.02, 0.006))
    sensor = replace(sensor_of(rig), elastomer=block)
    assert printed_pattern(sensor, PrintOptions(margin=0.001)).fits_gel
    assert not printed_pattern(sensor, PrintOptions(margin=0.00101)).fits_gel
    assert not printed_pattern(
        replace(sensor, elastomer=replace(block, size=(0.02, 0.009, 1)))
    ).fits_gel


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"process": "rolled"}, "process: found 'rolled', expected one of along_axis, unrolled"),
        ({"ink_gain": 6e-4}, "ink gain: found 600 um, expected 0 to less than 600 um"),
        (
            {"invert": True, "margin": 5e-5, "bleed": 5e-5, "ink_gain": 5e-5},
            "on inverted ink, expected 0, or less than half of margin and bleed, 50 um",
        ),
        ({"margin": -1e-3}, "margin: found -1 mm, expected 0 mm or more"),
        ({"bleed": float("nan")}, "bleed: found nan mm, expected 0 mm or more"),
    ],
)
def test_options_that_cannot_be_are_named(options, message, rig):
    with pytest.raises(InputError, match=re.escape(message)) as raised:
        printed_pattern(sensor_of(rig), PrintOptions(**options))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("surface", "needed"),
    [
        (PatternSurface("sphere_cap", 0.0075), "7.88162 mm"),
        (PatternSurface("cylinder", 0.0045, "x"), "4.6 mm"),
        (PatternSurface("cylinder", 0.0063, "y"), "6.4 mm"),
    ],
)
def test_a_print_that_is_wider_than_its_surface_is_refused(surface, needed, rig):
    """The corners alone would fit: it is the outer checkers and the margin that do not."""
    sensor = sensor_of(rig, surface)
    assert np.isfinite(sensor.pattern.corners()).all()
    with pytest.raises(InputError, match=r"pattern.surface.radius: found .* mm") as raised:
        printed_pattern(sensor)
    assert f"expected more than {needed}" in str(raised.value)
