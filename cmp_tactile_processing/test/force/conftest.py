"""Forces and displacements that the tests of force take for true: another mesh, other loads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from cmp_tactile_processing.elastic.mesh import MeshDensity
from cmp_tactile_processing.elastic.model import ElasticProblem, SurfaceGrid
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.measured import ForceField, Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_processing.surface.displacement import Reference, surface_at_rest

# Noise of a measured marker displacement along x, y, z, m.
NOISE_M = np.array([2e-6, 2e-6, 5e-6])
MEASURED = np.ones((20, 20), dtype=np.uint8)

# Of half as many unknowns than rim=4 and depth=5, and the same to 0.08 %.
TRUTH_DENSITY = MeshDensity(across=18, rim=3, depth=4, layer=1, growth=1.3)
TRUTH_NODES = 61


@dataclass(frozen=True)
class Press:
    """A load: displacement (rows, cols, 3) m of the markers; forces (n, 3) N at rest.

    moved (n, 3) m: of the markers below the forces.  turned (3,) N m: moment that the forces gain
    as the contact surface, which moves more, takes them along.
    """

    displacement: NDArray[np.float64]
    force: NDArray[np.float64]
    position: NDArray[np.float64]
    moved: NDArray[np.float64]
    turned: NDArray[np.float64]

    def wrench(self, scale: float = 1.0) -> NDArray[np.float64]:
        """Resultant and moment (6,) of the scaled load, which acts where the gel has moved to."""
        moment = np.cross(self.position, self.force).sum(axis=0)
        return np.concatenate(
            [scale * self.force.sum(axis=0), scale * moment + scale**2 * self.turned]
        )

    @property
    def centre(self) -> NDArray[np.float64]:
        """Centre of pressure, (3,) m."""
        return self.force[:, 2] @ (self.position + self.moved) / self.force[:, 2].sum()


def bump(
    xy: NDArray[np.float64], centre: tuple[float, float], radius: float
) -> NDArray[np.float64]:
    """Weights (n,), summing to 1, of a smooth round patch of pressure like that of a sphere."""
    distance2 = ((xy - np.array(centre)) ** 2).sum(axis=1) / radius**2
    weights = np.maximum(0, 1 - distance2) ** 1.5
    return weights / weights.sum()


def loads(xy: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Nodal forces (n, 3) N at the points (n, 2) m, 10 N of normal force each."""
    centred, off = bump(xy, (0, 0), 3e-3), bump(xy, (3e-3, -2e-3), 2.5e-3)
    small = bump(xy, (-1e-3, 1.5e-3), 1.5e-3)
    two = (bump(xy, (-3e-3, 0), 1.5e-3) + bump(xy, (3e-3, 1e-3), 1.5e-3)) / 2
    turn = np.stack([-xy[:, 1], xy[:, 0], np.zeros(len(xy))], axis=1) * centred[:, None]
    turn *= 0.01 / (xy[:, 0] @ turn[:, 1] - xy[:, 1] @ turn[:, 0])
    down = np.array([0.0, 0.0, -10.0])
    return {
        "press": centred[:, None] * down,
        "small press": small[:, None] * down,
        "shear": centred[:, None] * (down + [3.0, 1.0, 0.0]),
        "torque": centred[:, None] * down + turn,
        "off centre": off[:, None] * (down + [1.0, -1.0, 0.0]),
        "two contacts": two[:, None] * down,
    }


def presses(sensor: SensorDescription) -> dict[str, Press]:
    """All loads on a sensor, solved on a finer and differently graded mesh than its model's."""
    problem = ElasticProblem.from_sensor(sensor)
    grid = SurfaceGrid(TRUTH_NODES, TRUTH_NODES, problem.nodes.extent)
    problem = replace(problem, nodes=grid, density=TRUTH_DENSITY)
    forces = loads(grid.points)
    columns = np.stack([force.ravel() for force in forces.values()], axis=1)
    turning = [_turning(force) for force in forces.values()]
    responses = problem.responses(np.concatenate([columns, *turning], axis=1))
    young, count = sensor.elastomer.young, len(forces)
    moved = problem.expand([part.markers for part in responses], of_nodes=False) / young
    work = sum(part.work for part in responses) / young
    height = problem.geometry.surface.height(grid.points) + problem.geometry.layer
    position = np.concatenate([grid.points, height[:, None]], axis=1)
    markers = problem.markers
    found = {}
    for index, (name, force) in enumerate(forces.items()):
        displacement = moved[:, index].reshape(markers.rows, markers.cols, 3)
        at_nodes = RegularGridInterpolator((markers.y, markers.x), displacement, method="cubic")
        start = count + 3 * index
        turned = work[start : start + 3, index]
        found[name] = Press(displacement, force, position, at_nodes(grid.points[:, ::-1]), turned)
    return found


def _turning(force: NDArray[np.float64]) -> NDArray[np.float64]:
    """Loads (3 n, 3) whose work on a displacement is the moment that `force` gains by it."""
    x, y, z = force.T
    zero = np.zeros(len(force))
    about = [(zero, z, -y), (-z, zero, x), (y, -x, zero)]
    return np.stack([np.stack(load, axis=1).ravel() for load in about], axis=1)


def noisy(displacement: NDArray[np.float64], seed: int = 0) -> NDArray[np.float64]:
    """The displacement as a frame shows it."""
    return displacement + np.random.default_rng(seed).normal(size=displacement.shape) * NOISE_M


def alone(model: ForceModel, *frame: NDArray[Any]) -> ForceField:
    """The field of a frame that comes first."""
    model.reset()
    return model.reconstruct(*frame)


def errors(
    model: ForceModel, press: Press, scale: float = 1.0, status: NDArray[np.uint8] = MEASURED
) -> NDArray[np.float64]:
    """Root mean square over four draws of noise: along z and across, N; about z and across, N m."""
    squares = []
    for seed in range(4):
        field = model.reconstruct(noisy(scale * press.displacement, seed), status)
        wrong = (field.wrench - press.wrench(scale)) ** 2
        squares.append([wrong[2], wrong[:2].sum(), wrong[5], wrong[3:5].sum()])
    return np.sqrt(np.mean(squares, axis=0))


def sag(deep_m: float, drag_m: float = 0.0) -> NDArray[np.float64]:
    """A smooth hollow made by hand, which no elastic gel shows: (20, 20, 3) m."""
    x, y = np.meshgrid(*2 * [(np.arange(20) - 9.5) * 0.0145 / 21])
    shape = np.exp(-(x**2 + y**2) / (2 * 2e-3**2))
    return shape[..., None] * [drag_m, 0.0, -deep_m]


SAGS = [
    noisy(sag(deep, drag), seed)
    for seed, (deep, drag) in enumerate([(3e-4, 0), (5e-4, 0), (8e-4, 0), (8e-4, 3e-4)])
]


@pytest.fixture(scope="session")
def truth(sensor: SensorDescription) -> dict[str, Press]:
    """Loads of 10 N on the packaged rig."""
    return presses(sensor)


@pytest.fixture(scope="session")
def cache_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache folder that is empty at first."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def model(sensor: SensorDescription, cache_dir: Path) -> ForceModel:
    """The force model of the packaged rig, as a user gets it."""
    return ForceModel(sensor, cache_dir)


@pytest.fixture(scope="session")
def other_rig(sensor: SensorDescription) -> Callable[..., SensorDescription]:
    """Makes a rig with rows x cols markers over 13 mm on another surface."""

    def make(rows: int, cols: int, surface: PatternSurface) -> SensorDescription:
        pitch = 0.013 / (max(rows, cols) - 1)
        pattern = replace(sensor.pattern, rows=rows, cols=cols, pitch=pitch, surface=surface)
        return replace(sensor, pattern=pattern, name=f"{surface.type}_{rows}x{cols}")

    return make


@pytest.fixture(scope="session")
def seen(sensor: SensorDescription) -> Callable[..., Surface]:
    """Makes the surface that is seen of a displacement from `zero`, with noise of the seed."""
    rest = surface_at_rest(Reference.nominal(sensor), sensor.pattern.shape)

    def make(
        displacement: NDArray[np.float64],
        seed: int = 1,
        zero: NDArray[np.float64] | float = 0.0,
        **changes: Any,
    ) -> Surface:
        reference, moved = rest.reference + zero, noisy(displacement, seed)
        surface = replace(
            rest,
            reference=reference,
            position=reference + moved,
            displacement=moved,
            covariance=np.broadcast_to(np.diag(NOISE_M**2), (*moved.shape, 3)).copy(),
            ray_gap=np.zeros(moved.shape[:2]),
        )
        return replace(surface, **changes)

    return make
