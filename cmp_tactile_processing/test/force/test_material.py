"""Material from known loads, against gels of other material that were solved on another mesh."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.calibration.material.calibrate import (
    LoadSample,
    MaterialOptions,
    fit_material,
    range_findings,
)
from cmp_tactile_processing.calibration.material.compliance import ComplianceFamily
from cmp_tactile_processing.calibration.material.fit import (
    Load,
    LoadInverse,
    fit_loads,
    force_deviations,
)
from cmp_tactile_processing.calibration.material.loads import Readings
from cmp_tactile_processing.calibration.outcome import Severity
from cmp_tactile_processing.elastic.mesh import MeshDensity
from cmp_tactile_processing.elastic.model import ElasticProblem, SurfaceGrid
from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.force.large_press import LargePress

from .conftest import MEASURED, NOISE_M
from .conftest import loads as loads_of_10_n

# Only Young's modulus is sought: no elastic model needs to be built.
YOUNG_ALONE = MaterialOptions(poisson=0.0, thickness=0.0, layer_thickness=0.0, layer_factor=1.0)
YOUNG_AND_POISSON = replace(YOUNG_ALONE, poisson=0.015)
OTHER_POISSON, OTHER_YOUNG = 0.465, 4e5


def loads(xy):
    """Nodal forces (n, 3) N of some loads of half a newton."""
    return {name: 0.05 * force for name, force in loads_of_10_n(xy).items()}


def sample(moved, force, seed, name=""):
    """A measured load: noise of a frame, and a reference that is wrong by 0.2 % or 1 mN."""
    random = np.random.default_rng(seed)
    std = np.maximum(2e-3 * np.abs(force), 1e-3)
    return LoadSample(
        displacement=moved + random.normal(size=moved.shape) * NOISE_M,
        status=MEASURED,
        force=force + random.normal(size=3) * std,
        std=std,
        name=name,
    )


@pytest.fixture(scope="module")
def described(truth):
    """Samples of a gel that is as described."""
    names = ("press", "shear", "off centre", "torque")
    scales = (0.02, 0.05, 0.03, 0.04)
    return [
        sample(scale * truth[name].displacement, scale * truth[name].force.sum(axis=0), seed, name)
        for seed, (name, scale) in enumerate(zip(names, scales, strict=True))
    ]


@pytest.fixture(scope="module")
def other(sample_rig):
    """Displacement and force of loads on a gel of another modulus and Poisson's ratio."""
    problem = ElasticProblem.from_sensor(sample_rig)
    grid = SurfaceGrid(61, 61, problem.nodes.extent)
    density = MeshDensity(across=16, rim=3, depth=4, growth=1.3)
    problem = replace(problem, poisson=OTHER_POISSON, nodes=grid, density=density)
    forces = loads(grid.points)
    columns = np.stack([force.ravel() for force in forces.values()], axis=1)
    moved = problem.expand(problem.solve(columns), of_nodes=False) / OTHER_YOUNG
    return {
        name: (moved[:, k].reshape(20, 20, 3), forces[name].sum(axis=0))
        for k, name in enumerate(forces)
    }


@pytest.fixture(scope="module")
def family(sample_rig, model, cache_dir):
    return ComplianceFamily(sample_rig, model.elastic, YOUNG_AND_POISSON, cache_dir=cache_dir)


def fitted(sample_rig, model, family, samples, options=YOUNG_AND_POISSON):
    """Fit and the relative deviations of normal and tangential force."""
    found = [
        Load(
            LoadInverse(
                item, model.reconstruct(item.displacement, item.status), model.elastic, sample_rig
            ),
            item.reference,
            item.reference_std,
        )
        for item in samples
    ]
    fit = fit_loads(family, found, options, sample_rig.elastomer.young, np.zeros(6))
    return found, fit, force_deviations(family, found, fit)


def test_modulus_and_poisson_ratio_from_presses_and_a_sideways_load(
    sample_rig, cache_dir, other, family
):
    """From another mesh, with the noise of one frame: E within 1 %, Poisson's ratio within 0.005.

    `family` is asked for so that what it built is found in the cache.
    """
    names = ("press", "shear", "off centre")
    samples = [sample(*other[name], seed, name) for seed, name in enumerate(names)]
    outcome = fit_material(sample_rig, samples, "weights", YOUNG_AND_POISSON, cache_dir=cache_dir)
    assert outcome.accepted, outcome.findings
    gel, record = outcome.sensor.elastomer, outcome.record
    assert gel.young == pytest.approx(OTHER_YOUNG, rel=0.01)
    assert gel.poisson == pytest.approx(OTHER_POISSON, abs=0.005)
    assert gel.shading_layer.young == pytest.approx(gel.young)
    assert gel.size == sample_rig.elastomer.size
    assert record == gel.calibration
    assert record.determined[:2] == ("elastomer.young", "elastomer.poisson")
    assert record.samples == 3
    assert abs(gel.young - OTHER_YOUNG) < 3 * record.young_std * gel.young
    assert abs(gel.poisson - OTHER_POISSON) < 3 * record.poisson_std
    assert record.normal_std < 0.01
    for load in outcome.loads:
        # The first material shows a quarter too much.
        assert abs(load.residual_before[2]) > 0.2 * abs(load.reference[2])
        assert (np.abs(load.residual_after) < 4 * np.hypot(load.after_std, 5e-3)).all()


def pushed(sample_rig, model, family, other, fit):
    """The sideways load, which was not among the samples, as the fitted gel shows it."""
    item = sample(*other["shear"], 9)
    field = model.reconstruct(item.displacement, item.status)
    inverse = LoadInverse(item, field, model.elastic, sample_rig)
    inverse.adapt(family, fit.shape)
    view = inverse.view(family, fit.shape)
    return inverse, (fit.young * view.resultant[:3], view)


def test_deviations_cover_a_poisson_ratio_that_was_held_and_is_wrong(
    sample_rig, model, family, other
):
    """One prior deviation off, presses alone: E makes up for it along z, and sideways it shows."""
    item = sample(*other["press"], 1)
    item = replace(item, force=np.array([np.nan, np.nan, item.force[2]]))
    held = replace(YOUNG_AND_POISSON, held_share=0.01)
    _, fit, (normal, tangential) = fitted(sample_rig, model, family, [item], held)
    assert fit.held.all()
    assert fit.shape[0] == sample_rig.elastomer.poisson
    _, (shown, _) = pushed(sample_rig, model, family, other, fit)
    truth = other["shear"][1]
    assert abs(shown[2] / truth[2] - 1) < 3 * normal + 0.01
    assert abs(shown[0] / truth[0] - 1) < 3 * tangential
    assert abs(shown[0] / truth[0] - 1) > 3e-3


def test_deviations_are_those_of_repeated_measurements(sample_rig, model, family):
    """Twelve draws of noise on one sideways load of the same gel, one step from the truth each."""
    nodes = model.elastic.nodes.points
    force = loads(nodes)["shear"]
    moved, total = model.elastic.displacement(force), force.sum(axis=0)
    squares = []
    for seed in range(12):
        item = sample(moved, total, seed)
        field = model.reconstruct(item.displacement, item.status)
        inverse = LoadInverse(item, field, model.elastic, sample_rig)
        inverse.adapt(family, family.start)
        view = inverse.view(family, family.start)
        slope = view.misfit_slope / inverse.noise_scale
        information = slope.T @ slope + np.diag(family.prior_std**-2.0)
        step = -np.linalg.solve(information, slope.T @ view.misfit / inverse.noise_scale)
        squares.append(step[0] ** 2 * information[0, 0])
    # The mean of twelve squares of a standard normal is within 0.3 and 2 with 99 %.
    assert 0.3 < np.mean(squares) < 2.0


@pytest.mark.parametrize("young", [2.5e5, 5e5, 1.2e6])
def test_young_alone(sample_rig, cache_dir, described, young):
    """The others held: nothing is built, and the old modulus does not matter."""
    gel = replace(sample_rig.elastomer, young=young)
    gel = replace(gel, shading_layer=replace(gel.shading_layer, young=young))
    sensor = replace(sample_rig, elastomer=gel)
    outcome = fit_material(sensor, described, "weights", YOUNG_ALONE, cache_dir=cache_dir)
    assert outcome.accepted, outcome.findings
    assert outcome.sensor.elastomer.young == pytest.approx(5e5, rel=0.01)
    assert outcome.sensor.elastomer.poisson == gel.poisson
    # Half a percent of model error, which four loads have in common.
    assert 0.004 < outcome.record.normal_std < 0.008
    assert all(load.used for load in outcome.loads)
    assert "elastomer.poisson" in outcome.record.held


def test_a_wrong_load_is_named_and_left_out(sample_rig, cache_dir, described):
    wrong = replace(described[2], force=1.3 * described[2].force, name="200 g")
    samples = [*described[:2], wrong, described[3]]
    outcome = fit_material(sample_rig, samples, "weights", YOUNG_ALONE, cache_dir=cache_dir)
    assert outcome.accepted, outcome.findings
    assert [load.used for load in outcome.loads] == [True, True, False, True]
    assert outcome.sensor.elastomer.young == pytest.approx(5e5, rel=0.01)
    assert any("Load 3 (200 g) was left out" in item.text for item in outcome.findings)


def test_two_loads_that_contradict_each_other(sample_rig, cache_dir, described):
    samples = [described[1], replace(described[3], force=1.5 * described[3].force)]
    outcome = fit_material(sample_rig, samples, "weights", YOUNG_ALONE, cache_dir=cache_dir)
    assert not outcome.accepted
    assert any("contradict one another" in item.text for item in outcome.findings)


def test_offset_of_the_reference_sensor(sample_rig, cache_dir, described):
    offset = np.array([0.05, 0.0, -0.1])
    samples = [replace(item, force=item.force + offset) for item in described]
    outcome = fit_material(sample_rig, samples, "force_sensor", YOUNG_ALONE, cache_dir=cache_dir)
    assert outcome.accepted, outcome.findings
    assert outcome.sensor.elastomer.young == pytest.approx(5e5, rel=0.03)
    np.testing.assert_allclose(outcome.offset[:3], offset, atol=0.015)
    assert (np.abs(outcome.offset[:3] - offset) < 4 * outcome.offset_std[:3]).all()
    assert any("has an offset" in item.text for item in outcome.findings)
    assert np.isnan(outcome.offset[3:]).all()


def test_large_strain_is_taken_off(sample_rig, model, cache_dir):
    """A neo-Hookean gel that is described a fifth too stiff, under 1.5 N on a patch of 3 mm."""
    force = 3 * loads(model.elastic.nodes.points)["press"]
    gel = sample_rig.elastomer
    press = LargePress(ElasticProblem.from_sensor(sample_rig), gel.young, cache_dir)
    excess = press.excess(force)
    moved = model.elastic.displacement(force) + excess
    assert np.abs(excess).max() > 0.03 * np.abs(moved).max()
    layer = replace(gel.shading_layer, young=1.2 * gel.young)
    gel = replace(gel, model="neo_hookean", young=1.2 * gel.young, shading_layer=layer)
    sensor = replace(sample_rig, elastomer=gel)
    samples = [sample(moved, force.sum(axis=0), 3)]
    outcome = fit_material(sensor, samples, "weights", YOUNG_ALONE, cache_dir=cache_dir)
    assert outcome.accepted, outcome.findings
    assert outcome.sensor.elastomer.young == pytest.approx(5e5, rel=0.01)
    assert not any("linear" in item.text for item in outcome.findings)


@pytest.mark.parametrize(
    ("model", "large_press", "advice"),
    [
        ("linear", "auto", "0.6 mm, 10.0% of its thickness.*wrong by up to 17%.*neo_hookean"),
        ("neo_hookean", "off", "Do not switch force.large_press off"),
        ("neo_hookean", "auto", None),
        ("linear", "on", None),
    ],
)
def test_presses_that_are_too_deep_for_a_linear_gel(sample_rig, model, large_press, advice):
    sensor = replace(
        sample_rig,
        elastomer=replace(sample_rig.elastomer, model=model),
        force=replace(sample_rig.force, large_press=large_press),
    )
    deep = np.full((20, 20, 3), [0.0, 0.0, -0.6e-3])
    found = [
        f"{item.text} {item.advice}"
        for item in range_findings(sensor, [replace(GOOD, displacement=deep)], MaterialOptions())
    ]
    assert len(found) == (advice is not None)
    assert advice is None or re.search(advice, found[0])
    shallow = replace(GOOD, displacement=deep / 10)
    assert not range_findings(sensor, [shallow], MaterialOptions())


def test_the_modulus_makes_the_readings_right_and_their_spread_is_kept():
    """Readings 2 % high along z, one more and one less, and those sideways another 3 % high."""
    reference = np.array([[0.0, 0.0, -1.0], [0.3, 0.4, -2.0], [np.nan, np.nan, -4.0]])
    shown = np.nan_to_num(reference) * [1.0506, 1.0506, 1.02] * [[1.01], [1.0], [0.99]]
    readings = Readings(shown, reference, np.full((3, 3), 1e-6))
    scale = readings.scale(0.005)
    assert scale == pytest.approx(1 / 1.02, rel=0.01)
    normal, tangential = readings.spread(scale)
    # Two of three loads are off by 1 %.
    assert normal == pytest.approx(0.01, rel=0.1)
    assert tangential == pytest.approx(0.03, rel=0.2)
    # References that may themselves be off so much explain the spread.
    unsure = replace(readings, std=0.03 * np.abs(np.nan_to_num(reference)) + 1e-6)
    assert unsure.spread(scale)[0] == 0


def turned(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    ("change", "finding"),
    [
        (-np.eye(3), "has the other sign"),
        (turned(180), r"turned by [+-]180 degrees"),
        (turned(90), r"turned by \+90 degrees"),
        (np.diag([-1.0, 1.0, 1.0]), "mirrored"),
    ],
)
def test_reference_in_another_frame(sample_rig, cache_dir, described, change, finding):
    """One clear finding, and the description as it was."""
    samples = [replace(item, force=change @ item.force) for item in described]
    outcome = fit_material(sample_rig, samples, "weights", YOUNG_ALONE, cache_dir=cache_dir)
    assert not outcome.accepted
    assert len(outcome.findings) == 1
    assert re.search(finding, outcome.findings[0].text)
    assert outcome.sensor is sample_rig
    assert outcome.record is None


def test_nothing_that_touches(sample_rig, cache_dir):
    samples = [sample(np.zeros((20, 20, 3)), np.array([0.0, 0.0, -0.5]), 0)]
    outcome = fit_material(sample_rig, samples, "weights", YOUNG_ALONE, cache_dir=cache_dir)
    assert not outcome.accepted
    assert outcome.findings[0].severity is Severity.ERROR
    assert "shows no contact" in outcome.findings[0].text
    assert outcome.loads[0].reason


def test_one_press_is_enough_and_is_said_to_be_little(sample_rig, cache_dir, described):
    outcome = fit_material(sample_rig, described[:1], "weights", YOUNG_ALONE, cache_dir=cache_dir)
    assert outcome.accepted
    texts = " ".join(item.text for item in outcome.findings)
    assert "one load only" in texts
    assert "Only presses were given" in texts


GOOD = LoadSample(np.zeros((20, 20, 3)), MEASURED, np.array([0, 0, -1.0]), np.full(3, 0.01))


@pytest.mark.parametrize(
    ("samples", "method", "message"),
    [
        ([], "weights", "samples: found none, expected at least one known load"),
        ([GOOD], "scale", "method: found 'scale', expected weights or force_sensor"),
        (
            [GOOD, replace(GOOD, displacement=np.zeros((20, 19, 3)), name="50 g")],
            "weights",
            r"load 2 \(50 g\): displacement: found shape \(20, 19, 3\), expected \(20, 20, 3\)",
        ),
        (
            [replace(GOOD, status=MEASURED.ravel())],
            "weights",
            r"load 1: status: found shape \(400,\), expected \(20, 20\)",
        ),
        ([replace(GOOD, force=np.zeros(2))], "weights", r"force: found shape \(2,\)"),
        ([replace(GOOD, force=np.full(3, np.nan))], "weights", "expected one known component"),
        ([replace(GOOD, std=np.zeros(3))], "weights", r"std: found \[0, 0, 0\], expected a number"),
        (
            [replace(GOOD, torque=np.zeros(3))],
            "weights",
            r"torque_std: found \[nan, nan, nan\], expected a number above 0",
        ),
    ],
)
def test_what_cannot_be_used_is_named(sample_rig, samples, method, message):
    with pytest.raises(CalibrationError, match=f"sample_rig: .*{message}"):
        fit_material(sample_rig, samples, method)
