"""What large strain adds to the linear model, and the fixed point that takes it off."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.elastic.mesh import MeshDensity
from cmp_tactile_processing.elastic.model import ElasticProblem
from cmp_tactile_processing.errors import NotConvergedError
from cmp_tactile_processing.force.large_press import LargePress, settle

COARSE = MeshDensity(across=4, rim=1, depth=2, growth=2.0)

# Steps end below 5e-4 of the displacement; what is left is some times that where they shrink
# slowly, against an excess of a tenth of the displacement.
SAME = 2e-2

# A press of 0.44 mm, N.
LARGE = 0.9


@pytest.fixture(scope="module")
def problem(sensor) -> ElasticProblem:
    return ElasticProblem.from_sensor(sensor)


@pytest.fixture(scope="module")
def shared(problem, sensor, cache_dir) -> LargePress:
    return LargePress(problem, sensor.elastomer.young, cache_dir, density=COARSE)


@pytest.fixture
def press(shared) -> LargePress:
    """A gel at rest."""
    shared.reset()
    return shared


def load(problem, normal, along_x=0.0, at=(4e-4, -3e-4)) -> np.ndarray:
    """Nodal forces of a smooth patch of 2 mm radius."""
    squared = ((problem.nodes.points - at) ** 2).sum(axis=1) / 2e-3**2
    weights = np.sqrt(np.maximum(0, 1 - squared))
    return weights[:, None] / weights.sum() * [along_x, 0, -normal]


def test_small_forces_add_a_square(press, problem):
    """Half the force, a quarter of the excess: no linear part, of rounding or of another mesh."""
    loads = 0.05 * 0.5 ** np.arange(3)
    sizes = [np.linalg.norm(press.excess(load(problem, n, 0.3 * n), 1e-11)) for n in loads]
    assert np.diff(np.log(sizes)) / np.log(0.5) == pytest.approx(2, abs=0.15)
    assert (press.excess(0 * load(problem, 1.0)) == 0).all()
    assert (press.moved == 0).all()


def test_the_way_to_a_force_does_not_matter(press, problem):
    goal = load(problem, LARGE, 0.2)
    straight = press.excess(goal)
    cold = press.steps
    press.excess(load(problem, 0.4 * LARGE, -0.1, (-2e-3, 1e-3)))
    press.excess(load(problem, 0.9 * LARGE, 0.2))
    other_way = press.excess(goal)
    assert np.linalg.norm(other_way - straight) < SAME * np.linalg.norm(straight)
    assert press.steps < cold
    press.excess(goal)
    assert press.steps <= 2


def test_a_force_that_the_gel_cannot_follow(press, problem):
    """A clear error in bounded time; afterwards the gel is at rest and as good as before."""
    force = load(problem, LARGE)
    before = press.excess(force)
    with pytest.raises(NotConvergedError, match=r"no solution for the force \(0, 0, -50\) N"):
        press.excess(load(problem, 50.0))
    assert (press.latest == 0).all()
    assert np.linalg.norm(press.excess(force) - before) < SAME * np.linalg.norm(before)
    with pytest.raises(NotConvergedError):
        press.excess(np.full_like(force, np.nan))


def test_settling_of_a_scalar_problem():
    """u = f + 0.3 f^2, plainly known; missing values stay missing."""

    def excess(force, accuracy):
        assert accuracy > 0
        return 0.3 * force**2

    def solve(displacement):
        return np.where(np.isfinite(displacement), displacement, 0.5)

    displacement = np.full((2, 3, 3), 0.5 + 0.3 * 0.5**2)
    displacement[1, 2] = np.nan
    solution, settled = settle(solve, excess, displacement, noise=1e-9)
    assert settled
    assert solution == pytest.approx(0.5, abs=2e-3)
    start = 0.3 * solution**2
    calls = []
    settle(solve, lambda f, a: calls.append(a) or excess(f, a), displacement, start, noise=1e-9)
    assert len(calls) <= 2


def test_what_does_not_settle_says_so():
    """A fixed point that throws further away at every round, beyond what extrapolation mends."""
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(27, 27)))[0] * 4
    displacement = rng.normal(size=(3, 3, 3))
    _, settled = settle(lambda d: d, lambda f, _: (turn @ f.ravel()).reshape(f.shape), displacement)
    assert not settled
