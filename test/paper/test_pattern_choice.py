"""The sweep over patterns: cameras are scaled rightly, and errors are those that were put in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.library import load_sensor
from cmp_tactile_processing.sensor.pattern import Pattern
from cmp_tactile_processing.surface.dense import DenseStatus, DenseSurface
from cmp_tactile_simulation.rendering.deformed_surface import DeformedSurface
from paper import pattern_choice
from paper.experiment import Workplace
from paper.pattern_choice_fields import FIELDS, SLOPE, WAVELENGTHS, waves
from paper.pattern_choice_rig import CONDITIONS, PRINT_SIDE, condition, of_width, printed
from paper.pattern_choice_score import (
    NODES,
    field_rms,
    finest_wave,
    true_displacement,
    wave_gains,
)


def dense_of(displacement: NDArray[np.float64]) -> DenseSurface:
    rest = np.zeros_like(displacement)
    status = np.full(displacement.shape[:2], DenseStatus.MEASURED, np.uint8)
    return DenseSurface(NODES, rest, rest + displacement, displacement, status)


def bump(pattern: Pattern, depth: float) -> DeformedSurface:
    grid = SurfaceGrid(111, 111, (0.022, 0.022))
    moved = np.zeros((grid.rows * grid.cols, 3))
    moved[:, 2] = -depth * np.exp(-(grid.points**2).sum(axis=1) / (2 * 0.002**2))
    return DeformedSurface(pattern, grid, moved.reshape(grid.rows, grid.cols, 3))


@pytest.mark.parametrize("width", [512, 640, 1600])
def test_a_camera_of_another_width_sees_the_same_in_other_pixels(width: int) -> None:
    """Pixel edges scale, so centres at whole numbers need their half pixel."""
    sensor = load_sensor("prototype")
    before, after = build_views(sensor), build_views(of_width(sensor, width))
    corners = sensor.pattern.corners()
    for name, view in before.items():
        expected = (view.project(corners) + 0.5) * width / 1024 - 0.5
        np.testing.assert_allclose(after[name].project(corners), expected, atol=1e-9)


def test_a_width_that_leaves_half_pixels_is_refused() -> None:
    with pytest.raises(ValueError, match="keeps all sizes whole"):
        of_width(load_sensor("prototype"), 1001)


def test_a_print_keeps_its_size_whatever_its_checkers() -> None:
    sensor = load_sensor("prototype")
    for corners in (8, 20, 60):
        pattern = printed(sensor, corners, 2).pattern
        assert (pattern.cols + 1) * pattern.pitch == pytest.approx(PRINT_SIDE)
        assert pattern.shape.corners == (corners, corners)
    assert printed(sensor, sensor.pattern.cols, 6).pattern.pitch == pytest.approx(
        sensor.pattern.pitch
    )


def test_blur_grows_with_the_resolution_and_noise_does_not() -> None:
    for name, settings in CONDITIONS.items():
        fine = condition(name, 2048)
        assert fine == replace(settings, blur=2 * settings.blur)


def test_the_error_of_a_field_is_what_was_added() -> None:
    """A tenth of the nodes off by (3, 0, 4) um: RMS 5 um * sqrt(0.1)."""
    truth = true_displacement(bump(load_sensor("prototype").pattern, 5e-4))
    assert truth[..., 2].min() == pytest.approx(-5e-4, rel=1e-3)
    off = truth.copy()
    off.reshape(-1, 3)[::10] += (3e-6, 0.0, 4e-6)
    share = len(off.reshape(-1, 3)[::10]) / (NODES.rows * NODES.cols)
    assert field_rms(dense_of(off), truth) == pytest.approx(5e-6 * np.sqrt(share))


def test_a_field_with_a_hole_has_no_error_to_tell() -> None:
    """Otherwise a pattern that loses the difficult part would come out best."""
    truth = np.zeros((NODES.rows, NODES.cols, 3))
    holed = truth.copy()
    holed[:20, :20] = np.nan
    assert np.isnan(field_rms(dense_of(holed), truth))
    few = truth.copy()
    few[:10, :10] = np.nan
    assert field_rms(dense_of(few), truth) == 0.0


@pytest.mark.parametrize("which", [0, 1])
def test_the_gain_of_each_wave_is_told_apart_from_the_others(which: int) -> None:
    """All waves at once, one of them halved and one lost."""
    pattern = load_sensor("prototype").pattern
    surface = waves(pattern, which)
    truth = true_displacement(surface)
    measured = truth * 0.8
    gains = wave_gains(dense_of(measured), truth, which)
    # The surface is a spline through samples of the waves: the finest is not quite a sine.
    np.testing.assert_allclose(gains, 0.8, rtol=1e-6)
    bare = np.zeros_like(truth)
    assert np.abs(wave_gains(dense_of(bare), truth, which)).max() < 1e-9


def test_waves_are_as_steep_as_said() -> None:
    """The sum of all slopes bounds the tilt; each wave is in there with its amplitude."""
    truth = true_displacement(waves(load_sensor("prototype").pattern, 0))[..., 2]
    amplitudes = SLOPE * WAVELENGTHS / (2 * np.pi)
    assert truth.std() == pytest.approx(np.sqrt((amplitudes**2).sum() / 2), rel=0.15)


def test_the_finest_wave_lies_where_half_of_the_amplitude_is_left() -> None:
    gains = np.where(np.arange(len(WAVELENGTHS)) < 4, 1.0, 0.0)
    assert finest_wave(gains) == pytest.approx(np.sqrt(WAVELENGTHS[3] * WAVELENGTHS[4]))
    assert finest_wave(np.ones(len(WAVELENGTHS))) == WAVELENGTHS[-1]
    assert np.isnan(finest_wave(np.zeros(len(WAVELENGTHS))))
    assert np.isnan(finest_wave(np.full(len(WAVELENGTHS), np.nan)))


def test_a_cell_measures_a_bump(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """All markers found, the field to within micrometres; too fine a print is refused."""

    def bumps(_: Workplace, pattern: Pattern) -> dict[str, DeformedSurface]:
        found = {name: bump(pattern, 1e-4 * k) for k, name in enumerate(FIELDS, 1)}
        return {**found, "waves 0": waves(pattern, 0), "waves 1": waves(pattern, 1)}

    monkeypatch.setattr(pattern_choice, "deformations", bumps)
    monkeypatch.setattr(pattern_choice, "CONDITIONS", {"good": CONDITIONS["good"]})
    place = Workplace(tmp_path)
    cells = pattern_choice.measured(place, "prototype", 512, (10, 60), (6,))
    assert cells["side_least"][1] < 3 < cells["side_least"][0]
    assert cells["visible"][0] == 2 * 2 * len(FIELDS) * 10 * 10
    assert cells["lost"][0] == cells["wrong"][0] == 0
    # A marker's displacement is known to about 3 um at this resolution.
    assert np.all((cells["field"][0] > 1e-7) & (cells["field"][0] < 6e-6))
    assert cells["gain"][0, 0, 0] == pytest.approx(1.0, abs=0.15)
    assert np.isnan(cells["field"][1]).all()
    assert np.isnan(cells["lost"][1]).all()
