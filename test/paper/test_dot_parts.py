"""Parts of the dot methods against closed forms."""

import numpy as np
import pytest
from numpy.typing import NDArray

from paper.dots import centroid_bias, outlines

RADIUS = 5.0
TO_RADII = np.eye(2)[None] / RADIUS
# An outline is read off pixels without blur, whose steps are a tenth of the radius.
STEP = 0.1


def _disc(centre: tuple[float, float], stretch: float = 1.0) -> NDArray[np.float32]:
    """Darkness of an ellipse of half axes RADIUS * stretch, RADIUS; 8 x 8 samples to a pixel."""
    fine = (np.arange(41 * 8) + 0.5) / 8 - 0.5
    inside = ((fine - centre[0]) / stretch) ** 2 + (fine[:, None] - centre[1]) ** 2 < RADIUS**2
    return np.asarray(inside.reshape(41, 8, 41, 8).mean(axis=(1, 3)), dtype=np.float32)


def test_outlines_tell_area_and_elongation() -> None:
    edge = outlines(_disc((20.2, 19.9), 1.4), np.array([[20.0, 20.0]]), TO_RADII)
    assert edge.area[0] == pytest.approx(1.4 * np.pi * RADIUS**2, rel=STEP)
    assert edge.elongation[0] == pytest.approx(1.4, rel=STEP)
    assert edge.residual[0] < 0.05


def test_the_bias_of_a_projected_disc_is_the_integral_over_it() -> None:
    """To second order in the radius; what is left is of fourth order, 1 % here."""

    def project(i: NDArray[np.float64], j: NDArray[np.float64]) -> NDArray[np.float64]:
        depth = 1 + 0.02 * j + 0.01 * i + 0.003 * i * i
        return 20 * np.stack([j / depth, (i + 0.1 * j) / depth], axis=-1)

    i, j = np.mgrid[-2:3, -2:3].astype(np.float64)
    radius, fine = 0.25, np.linspace(-0.25, 0.25, 801)
    u, v = np.meshgrid(fine, fine)
    inside = u**2 + v**2 < radius**2
    q = project(v[inside], u[inside])
    h = 1e-4
    by_u = (project(v[inside], u[inside] + h) - q) / h
    by_v = (project(v[inside] + h, u[inside]) - q) / h
    area = by_u[:, 0] * by_v[:, 1] - by_u[:, 1] * by_v[:, 0]
    exact = (q * area[:, None]).sum(axis=0) / area.sum() - project(np.zeros(1), np.zeros(1))[0]
    assert np.abs(exact).max() > 0.005
    assert centroid_bias(project(i, j), radius)[2, 2] == pytest.approx(exact, rel=0.05, abs=2e-4)
