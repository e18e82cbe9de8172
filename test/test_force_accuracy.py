"""Force of contacts that another mesh than the inverse's solved, from displacement and from images.

The truth is written by `benchmarks/force/test_data.py`; `benchmarks/force/force.py` measures the
same for more contacts, loads and noise.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from cmp_tactile_processing.elastic.model import ElasticProblem
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.measured import Status
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_simulation.gel import observers
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.simulator import SensorCamera

DATA = Path(__file__).parent / "data" / "force_truth.npz"
# Of a measured displacement along x, y, z, m: what the parameters of the force stage expect.
NOISE_M = np.array([2e-6, 2e-6, 5e-6])
FRAMES = 6
# What the benchmark is to reach: share of the force and N, N m, relative L2 at 10 N and at 1 N.
FORCE_SHARE, FORCE_N, TORQUE_NM = 0.01, 0.01, 0.5e-3
L2 = {10.0: 0.05, 1.0: 0.15}
# A neo-Hookean gel pressed in by 0.44 mm: share of Fz.
LARGE_PRESS_SHARE = 0.025
# End to end, from images: share of Fz and N.
RENDERED_SHARE, RENDERED_N = 0.03, 0.02


@dataclass(frozen=True)
class Truth:
    """A contact: displacement (rows, cols, 3) m, nodal force (M, 3) N, wrench (6,)."""

    newton: float
    displacement: np.ndarray
    force: np.ndarray
    wrench: np.ndarray

    def noisy(self):
        """Displacements as frames show them."""
        random = np.random.default_rng(int(10 * self.newton))
        for _ in range(FRAMES):
            yield self.displacement + NOISE_M * random.standard_normal(self.displacement.shape)


@pytest.fixture(scope="module")
def model(sensor):
    return ForceModel(sensor)


@pytest.fixture(scope="module")
def data():
    with np.load(DATA, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


@pytest.fixture(scope="module")
def contacts(data):
    """By name and load, N."""
    columns = (data[key] for key in ("name", "newton", "displacement", "force", "wrench"))
    return {
        (str(name), float(newton)): Truth(float(newton), moved, force, wrench)
        for name, newton, moved, force, wrench in zip(*columns, strict=True)
    }


def seen(shape):
    return np.full(shape[:2], Status.MEASURED, dtype=np.uint8)


def found(model, truth):
    return [model.reconstruct(moved, seen(moved.shape)) for moved in truth.noisy()]


def test_the_truth_belongs_to_the_packaged_rig(sensor, data, contacts):
    """Otherwise every other test here would compare with the forces on another gel."""
    problem = ElasticProblem.from_sensor(sensor)
    np.testing.assert_allclose(data["material"], [sensor.elastomer.young, sensor.elastomer.poisson])
    for truth in contacts.values():
        assert truth.displacement.shape == (problem.markers.rows, problem.markers.cols, 3)
        # Sharing the force out to the nodes keeps it; values are kept in single precision.
        np.testing.assert_allclose(truth.force.sum(axis=0), truth.wrench[:3], atol=1e-5)


CASES = (
    ("sphere", 1.0), ("sphere", 10.0), ("two contacts", 1.0), ("off centre", 10.0),
    ("shear", 10.0), ("torque", 1.0),
)  # fmt: skip


@pytest.mark.parametrize("key", CASES, ids=lambda key: f"{key[0]}, {key[1]:g} N")
def test_force_torque_and_distribution(model, contacts, key):
    truth = contacts[key]
    for field in found(model, truth):
        off = field.wrench - truth.wrench
        tangential = np.linalg.norm(truth.wrench[:2])
        assert abs(off[2]) <= FORCE_SHARE * truth.newton + FORCE_N
        assert np.linalg.norm(off[:2]) <= FORCE_SHARE * tangential + FORCE_N
        assert np.linalg.norm(off[3:]) <= TORQUE_NM
        distance = np.linalg.norm(field.force - truth.force) / np.linalg.norm(truth.force)
        assert distance <= L2[truth.newton]


def test_large_press_of_a_neo_hookean_gel(sensor, data):
    """A flat pin goes in by 0.44 mm: the linear model shows 3.5 % too little, measured."""
    columns = (data[f"neo_hookean_{key}"][0] for key in ("newton", "displacement", "wrench"))
    newton, moved, true = columns
    gel = replace(sensor, elastomer=replace(sensor.elastomer, model="neo_hookean"))
    share = {}
    for choice in ("on", "off"):
        model = ForceModel(replace(gel, force=replace(sensor.force, large_press=choice)))
        noise = NOISE_M * np.random.default_rng(8).standard_normal(moved.shape)
        field = model.reconstruct(moved + noise, seen(moved.shape))
        assert field.corrected == (choice == "on")
        share[choice] = abs(field.wrench[2] - true[2]) / newton
    assert share["on"] <= LARGE_PRESS_SHARE < share["off"]


def test_force_from_rendered_images(sensor, data):
    """A sphere at 2 N, through tracking, triangulation and force; images with a camera's noise."""
    camera = SensorCamera(sensor, load_scene("contact_sphere").look)
    pressed, true = data["rendered_displacement"].astype(np.float64), data["rendered_wrench"]
    rest, surface = (
        DeformedSurface(sensor.pattern, observers(sensor), moved)
        for moved in (np.zeros_like(pressed), pressed)
    )
    pipeline = Pipeline(sensor)
    pipeline.set_reference(camera.picture(index, rest) for index in range(4))
    field = pipeline.process(camera.picture(4, surface)).force
    assert abs(field.wrench[2] - true[2]) <= RENDERED_SHARE * abs(true[2]) + RENDERED_N
    assert np.linalg.norm(field.wrench[:2] - true[:2]) <= RENDERED_N
