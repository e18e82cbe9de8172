"""Errors of markers: means that leave out what is missing, and which markers are in contact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.rendering.renderer import OpticalTruth
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from paper.chain import (
    all_markers,
    virtual,
)


def test_a_shifted_surface_is_off_by_the_shift_everywhere() -> None:
    sensor = load_sensor("sample_rig")
    truth = OpticalTruth(sensor).surface(DeformedSurface.rest(sensor.pattern))
    shift = np.array([1e-6, -2e-6, 3e-6])
    off = replace(
        truth,
        position=truth.position + shift,
        displacement=truth.displacement + shift,
        row_position=truth.row_position + shift,
        col_position=truth.col_position + shift,
    )
    shape = sensor.pattern.shape
    between = np.prod(shape.row_lines) + np.prod(shape.col_lines)
    assert virtual(off, truth).shape == (between, 3)
    assert all_markers(off, truth).shape == (between + np.prod(shape.corners), 3)
    np.testing.assert_allclose(all_markers(off, truth) - shift, 0, atol=1e-15)
