"""Printed patterns and their defects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.sensor.dot_code import DOT_DIAMETER
from cmp_tactile_processing.sensor.parts import Pattern, PatternSurface
from cmp_tactile_simulation.rendering.ink import (
    DARK_GREY,
    LIGHT_GREY,
    Checkerboard,
    Dots,
    PrintDefects,
    ink_at,
    ink_of,
)

PITCH = 1e-3
DEFECTS = PrintDefects(missing_ink=30, splashes=20, ragged_edge=1e-5)


def _pattern(corner_checker="dark"):
    return Pattern(5, 8, PITCH, corner_checker, 2, PatternSurface())


def _at(pattern, rows, cols):
    """Material points at rows and columns counted in checkers' middles, 0 outside corner (0, 0)."""
    y = (np.asarray(rows) - pattern.rows / 2) * PITCH
    x = (np.asarray(cols) - pattern.cols / 2) * PITCH
    return np.stack(np.broadcast_arrays(x, y), axis=-1)


@pytest.mark.parametrize(("corner_checker", "first"), [("dark", 0), ("light", 1)])
def test_checkers_alternate_from_the_corner_checker_and_the_margin_is_light(corner_checker, first):
    pattern = _pattern(corner_checker)
    rows, cols = np.mgrid[-1:7, -1:10]
    grey = Checkerboard(pattern).grey(_at(pattern, rows, cols))
    printed = (rows >= 0) & (rows <= 5) & (cols >= 0) & (cols <= 8)
    dark = printed & ((rows + cols) % 2 == first)
    np.testing.assert_array_equal(grey, np.where(dark, DARK_GREY, LIGHT_GREY))


def test_dots_lie_on_the_corners_with_the_diameter_asked_for():
    pattern = _pattern()
    ink = Dots(pattern, diameter=0.4)
    y, x = np.mgrid[-4:4:997j, -6:6:1493j] * PITCH
    grey = ink.grey(np.stack([x, y], axis=-1))
    dark = np.mean(grey == DARK_GREY) * 8 * 12 * PITCH**2
    # Points of a lattice of 8 um, counted in dots of 400 um.
    assert dark == pytest.approx(5 * 8 * np.pi / 4 * (0.4 * PITCH) ** 2, rel=5e-3)
    assert (ink.grey(pattern.corners()[..., :2]) == DARK_GREY).all()
    assert set(np.unique(grey)) == {DARK_GREY, LIGHT_GREY}


@pytest.mark.parametrize("corner_checker", ["dark", "light"])
def test_the_dots_of_a_code_have_the_other_colour(corner_checker):
    coded = replace(_pattern(corner_checker), code="dots", code_seed=2)
    y, x = np.mgrid[-3:3:1201j, -4.5:4.5:1801j] * PITCH
    xy = np.stack([x, y], axis=-1)
    grey, plain = (Checkerboard(pattern).grey(xy) for pattern in (coded, _pattern(corner_checker)))
    changed = grey != plain
    np.testing.assert_array_equal(grey[changed] == LIGHT_GREY, plain[changed] == DARK_GREY)
    # Points of a lattice of 5 um, counted in dots of 180 um.
    area = np.count_nonzero(changed) * (PITCH / 200) ** 2
    assert area == pytest.approx(
        coded.dots().sum() * np.pi / 4 * (DOT_DIAMETER * PITCH) ** 2, rel=2e-2
    )
    middles = coded.checker_middles()
    beyond = np.linalg.norm(xy[changed][:, None] - middles[coded.dots()], axis=-1).min(axis=1)
    assert beyond.max() <= DOT_DIAMETER / 2 * PITCH * (1 + 1e-9)
    # Discrete markers have no checkers, so no code either.
    np.testing.assert_array_equal(Dots(coded).grey(xy), Dots(_pattern()).grey(xy))


@pytest.mark.parametrize("defects", [PrintDefects(), DEFECTS], ids=["clean", "flawed"])
@pytest.mark.parametrize(("kind", "code"), [("cmp", "none"), ("cmp", "dots"), ("dmp", "none")])
def test_grey_is_the_same_within_the_clear_distance(kind, code, defects):
    # The renderer takes pixels for evenly grey on the strength of this distance.
    ink = ink_of(replace(_pattern(), code=code), kind, defects, seed=3)
    rng = np.random.default_rng(5)
    for point in rng.uniform(-6e-3, 6e-3, (1500, 2)):
        grey, clear, _, _ = ink_at(*ink.arrays, *point)
        angle, share = rng.uniform(0, 2 * np.pi, 20), rng.uniform(0, 0.999, (20, 1))
        around = point + share * clear * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        assert (ink.grey(around) == grey).all(), f"at {point}, within {clear}"


def test_defects_depend_on_the_seed_and_on_nothing_else():
    xy = np.random.default_rng(0).uniform(-4e-3, 4e-3, (20000, 2))
    first = Checkerboard(_pattern(), DEFECTS, seed=1).grey(xy)
    np.testing.assert_array_equal(first, Checkerboard(_pattern(), DEFECTS, seed=1).grey(xy))
    assert (first != Checkerboard(_pattern(), DEFECTS, seed=2).grey(xy)).any()
    assert (first != Checkerboard(_pattern()).grey(xy)).any()


def test_missing_ink_lightens_and_splashes_darken():
    y, x = np.mgrid[-3:3:601j, -4.5:4.5:901j] * PITCH
    xy = np.stack([x, y], axis=-1)
    clean = Checkerboard(_pattern()).grey(xy)
    for defects, grey in (
        (PrintDefects(missing_ink=40), LIGHT_GREY),
        (PrintDefects(splashes=40), DARK_GREY),
    ):
        flawed = Checkerboard(_pattern(), defects, seed=4).grey(xy)
        changed = flawed != clean
        assert (flawed[changed] == grey).all()
        # About half of 40 blobs of mean square radius (1 + 1/12) r^2 fall on the other grey.
        area = np.count_nonzero(changed) * (PITCH / 100) ** 2
        assert area == pytest.approx(20 * np.pi * 8e-5**2 * 13 / 12, rel=0.5)


def test_edges_stray_as_far_as_asked():
    pattern = Pattern(40, 40, PITCH, "dark", 2, PatternSurface())
    deviation = 3e-5
    # A length that is no part of the pitch: places between the lattice's points of all kinds.
    defects = PrintDefects(ragged_edge=deviation, ragged_length=1.37e-4)
    ink = Checkerboard(pattern, defects, seed=2)
    # Across vertical edges between checkers, along their middle fifths.
    edges = np.arange(-19, 20) * PITCH + PITCH / 2
    along = (np.arange(-19, 20)[:, None] * PITCH + np.linspace(-1e-4, 1e-4, 5)).ravel()
    across = np.linspace(-2e-4, 2e-4, 401)
    x, y = edges[:, None, None] + across, along[:, None]
    grey = ink.grey(np.stack(np.broadcast_arrays(x, y), axis=-1))
    light = (grey == grey[..., :1]).mean(axis=-1)
    strayed = (light - 0.5) * 4e-4
    # 39 x 39 nearly independent places: 5 % is three standard errors.
    assert strayed.std() == pytest.approx(deviation, rel=0.05)
    assert abs(strayed.mean()) < 3 * deviation / 39
