"""Errors of markers: means that leave out what is missing, and which markers are in contact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.rendering.renderer import OpticalTruth
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from paper.chain import (
    all_markers,
    displacement_error,
    in_contact,
    largest,
    mean_absolute,
    root_mean_square,
    virtual,
)
from paper.gel import Mechanics

NAN = float("nan")
ERRORS = np.array([[3.0, -4.0, 0.0], [-1.0, 0.0, 0.0], [NAN, NAN, NAN]])


def mechanics(displacement: np.ndarray, contact: np.ndarray, nodes: np.ndarray) -> Mechanics:
    frames = len(displacement)
    return Mechanics(
        observers=SurfaceGrid(*displacement.shape[1:3], (0.02, 0.02)),
        rate=30.0,
        phase=np.array(["press"] * frames),
        displacement=displacement,
        node_position=nodes,
        contact=contact,
        wrench=np.zeros((frames, 6)),
    )


def test_missing_markers_count_for_nothing() -> None:
    np.testing.assert_allclose(mean_absolute(ERRORS), [2.0, 2.0, 0.0, 3.0])
    np.testing.assert_allclose(root_mean_square(ERRORS), [np.sqrt(5), np.sqrt(8), 0.0])
    np.testing.assert_allclose(largest(ERRORS), [3.0, 4.0, 0.0])


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
    np.testing.assert_allclose(displacement_error(off, truth) - shift, 0, atol=1e-12)


def test_markers_are_in_contact_where_their_nearest_node_is() -> None:
    line = np.linspace(-0.005, 0.005, 11)
    x, y = np.meshgrid(line, line)
    nodes = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
    touched = np.hypot(nodes[:, 0], nodes[:, 1] - 0.001) < 0.0021
    solved = mechanics(np.zeros((1, 4, 4, 3)), touched[None], nodes)
    markers = np.zeros((2, 2, 3))
    markers[..., 0] = [[0.0, 0.0], [0.0023, 0.0]]
    markers[..., 1] = [[0.003, 0.0034], [0.001, -0.0016]]
    np.testing.assert_array_equal(in_contact(solved, 0, markers), [[True, True], [True, False]])
