"""Depth that markers capture of a dent, and a quadratic through them."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.measured import Surface
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.file import load_scene
from paper.experiments.probe import Dents, Neighbourhood, captured_depth, dents_of
from paper.readings import Contact, mean_of
from paper.sequence import PrintedGel

PITCH = 0.7e-3


def dent(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Deepest, 0.3 mm, at (0.2, -0.1) mm."""
    x, y = (xy - (0.2e-3, -0.1e-3)).T
    return np.asarray(0.3e-3 - 200 * x * x - 60 * x * y - 300 * y * y)


def lattice(step: float, count: int) -> NDArray[np.float64]:
    line = (np.arange(count) - count // 2) * step
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("neighbourhood", [Neighbourhood(PITCH), Neighbourhood(PITCH, nearest=9)])
def test_quadratic_dent_is_recovered_between_its_markers(neighbourhood: Neighbourhood) -> None:
    xy = lattice(PITCH, 7)
    depth, fitted = captured_depth(Dents(xy, dent(xy)), (0.0, 0.0), 1e-3, neighbourhood)
    assert depth == pytest.approx(dent(np.zeros((1, 2)))[0])
    # The search goes in steps of a fortieth of a pitch.
    assert fitted == pytest.approx(0.3e-3, abs=0.1e-6)


def test_deepest_marker_is_sought_near_the_probe_alone() -> None:
    xy = np.array([[0.0, 0.0], [1e-4, 0.0], [5e-3, 0.0]])
    dents = Dents(xy, np.array([1e-4, 2e-4, 9e-4]))
    assert captured_depth(dents, (0.0, 0.0), 1e-3, Neighbourhood(PITCH))[0] == 2e-4
    assert np.isnan(captured_depth(dents, (0.0, 5e-3), 1e-3, Neighbourhood(PITCH))).all()


@pytest.fixture(scope="module")
def rest() -> Surface:
    sensor = load_scene("probe").sensor
    return PrintedGel(sensor, "cmp").truth(DeformedSurface.rest(sensor.pattern)).surface


def test_depths_are_against_the_mean_at_rest_and_lost_markers_are_left_out(rest: Surface) -> None:
    def lower(surface: Surface, by: float) -> Surface:
        down = np.array([0.0, 0.0, by])
        return replace(
            surface,
            position=surface.position - down,
            row_position=surface.row_position - down,
            col_position=surface.col_position - down,
        )

    pressed = lower(rest, 1e-4)
    pressed.position[3, 4] = np.nan
    pressed.row_position[2, 2, 1] = np.nan
    at_rest = mean_of([lower(rest, 1e-5), lower(rest, 3e-5)])
    dents = dents_of(Contact(at_rest, pressed), rest)
    assert dents.depth == pytest.approx(np.full(len(dents.depth), 0.8e-4), abs=1e-12)
    shape = rest.shape
    markers = sum(int(np.prod(s)) for s in (shape.corners, shape.row_lines, shape.col_lines))
    assert len(dents.depth) == len(dents.xy) == markers - 2
    assert not (np.abs(dents.xy - rest.position[3, 4, :2]).max(axis=1) < 1e-9).any()
