"""The sphere fit recovers known spheres, and says where there is none."""

import numpy as np
import pytest

from paper.experiments.balls import fit_sphere

# What is left of a diameter of 10 mm by double precision on a cap of 0.1 mm, m.
ROUNDING_M = 1e-10


def _cap(diameter: float, across: float, count: int, seed: int = 0) -> np.ndarray:
    """Points on the lower cap of a sphere, beside the origin."""
    rng = np.random.default_rng(seed)
    radius, angle = across / 2 * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    z = diameter / 2 - np.sqrt((diameter / 2) ** 2 - radius**2)
    return np.stack([x + 0.001, y - 0.002, z + 0.003], axis=1)


@pytest.mark.parametrize("diameter", [0.010, 0.020])
def test_a_known_cap_gives_its_sphere(diameter: float) -> None:
    fit = fit_sphere(_cap(diameter, 0.002, 30))
    assert fit.diameter == pytest.approx(diameter, abs=ROUNDING_M)
    assert fit.centre == pytest.approx([0.001, -0.002, 0.003 + diameter / 2], abs=ROUNDING_M)
    assert fit.rms < ROUNDING_M
    assert fit.count == 30


def test_noise_shows_in_rms_and_hardly_shifts_the_diameter() -> None:
    noise_m = 1e-6
    noise = np.random.default_rng(1).normal(0, noise_m, (400, 3))
    fit = fit_sphere(_cap(0.012, 0.0025, 400) + noise)
    # Four of 400 degrees of freedom are fitted; 10 % is three standard errors of the RMS.
    assert fit.rms == pytest.approx(noise_m, rel=0.1)
    # By error propagation 0.4 % is four standard errors for this cap.
    assert fit.diameter == pytest.approx(0.012, rel=0.004)


def test_too_few_or_flat_points_have_no_sphere() -> None:
    assert np.isnan(fit_sphere(_cap(0.01, 0.002, 3)).diameter)
    flat = _cap(0.01, 0.002, 30)
    flat[:, 2] = 0.0
    assert np.isnan(fit_sphere(flat).diameter)
    assert np.isnan(fit_sphere(np.zeros((10, 3))).diameter)
