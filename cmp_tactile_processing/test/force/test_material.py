"""Material from known loads, against gels of other material that were solved on another mesh."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.calibration.material.calibrate import (
    PoissonDoubt,
    Readings,
    fit_material,
    fit_scale,
    load_findings,
)
from cmp_tactile_processing.calibration.material.loads import LoadSample
from cmp_tactile_processing.elastic.mesh import MeshDensity
from cmp_tactile_processing.elastic.model import ElasticProblem, SurfaceGrid
from cmp_tactile_processing.errors import CalibrationError, Severity
from cmp_tactile_processing.force.large_press import LargePress

from .conftest import MEASURED, NOISE_M
from .conftest import loads as loads_of_10_n

# The described Poisson's ratio is taken for right.
POISSON_KNOWN = 0.0
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
def other(sensor):
    """Displacement and force of loads on a gel of another modulus and Poisson's ratio."""
    problem = ElasticProblem.from_sensor(sensor)
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


def test_modulus_and_what_a_wrong_poisson_ratio_leaves_open(sensor, cache_dir, other):
    """Of a gel on another mesh whose ratio is one standard deviation off: presses alone."""
    samples = [
        sample(*other[name], seed, name) for seed, name in enumerate(("press", "off centre"))
    ]
    outcome = fit_material(sensor, samples, "weights", cache_dir=cache_dir)
    assert outcome.accepted, outcome.findings
    gel, record = outcome.sensor.elastomer, outcome.record
    assert gel.poisson == sensor.elastomer.poisson
    assert gel.shading_layer.young == pytest.approx(gel.young)
    assert abs(gel.young - OTHER_YOUNG) < 3 * record.young_std * gel.young
    assert record == gel.calibration
    assert (record.determined, record.samples) == (("elastomer.young",), 2)
    for load in outcome.loads:
        # The first material shows a quarter too much.
        assert abs((load.before - load.reference)[2]) > 0.2 * abs(load.reference[2])
        assert (np.abs(load.residual_after) < 4 * np.hypot(load.after_std, 5e-3)).all()


@pytest.mark.parametrize("names", [("press",), ("press", "shear")])
def test_the_error_bar_of_sideways_forces_covers_a_wrong_poisson_ratio(
    sensor, model, cache_dir, other, names
):
    """Known sideways or not; where it is, the bar is that of what was seen."""
    samples = [sample(*other[name], seed, name) for seed, name in enumerate(names)]
    outcome = fit_material(sensor, samples, "weights", cache_dir=cache_dir)
    record = outcome.record
    moved, force = other["shear"]
    shown = model.reconstruct(moved, MEASURED).wrench[:3]
    off = shown * outcome.sensor.elastomer.young / sensor.elastomer.young / force - 1
    assert abs(off[0]) < 3 * record.tangential_std < 0.15
    assert abs(off[2]) < 3 * record.normal_std < 0.05
    only_presses = any("All loads are presses" in item.text for item in outcome.findings)
    assert only_presses == (names == ("press",))


@pytest.mark.parametrize("young", [2.5e5, 1.2e6])
def test_young_alone(sensor, cache_dir, described, young):
    """The others held: nothing is built, and the old modulus does not matter."""
    gel = replace(sensor.elastomer, young=young)
    gel = replace(gel, shading_layer=replace(gel.shading_layer, young=young))
    sensor = replace(sensor, elastomer=gel)
    outcome = fit_material(sensor, described, "weights", POISSON_KNOWN, cache_dir=cache_dir)
    assert outcome.accepted, outcome.findings
    assert outcome.sensor.elastomer.young == pytest.approx(5e5, rel=0.01)
    assert outcome.sensor.elastomer.poisson == gel.poisson
    # Half a percent of model error, which four loads have in common.
    assert 0.004 < outcome.record.normal_std < 0.008
    assert all(load.used for load in outcome.loads)
    assert "elastomer.poisson" in outcome.record.held


def test_a_wrong_load_is_named_and_left_out(sensor, cache_dir, described):
    wrong = replace(described[2], force=1.3 * described[2].force, name="200 g")
    samples = [*described[:2], wrong, described[3]]
    outcome = fit_material(sensor, samples, "weights", POISSON_KNOWN, cache_dir=cache_dir)
    assert outcome.accepted, outcome.findings
    assert [load.used for load in outcome.loads] == [True, True, False, True]
    assert outcome.sensor.elastomer.young == pytest.approx(5e5, rel=0.01)
    assert any("Load 3 (200 g) was left out" in item.text for item in outcome.findings)


def test_two_loads_that_contradict_each_other(sensor, cache_dir, described):
    samples = [described[1], replace(described[3], force=1.5 * described[3].force)]
    outcome = fit_material(sensor, samples, "weights", POISSON_KNOWN, cache_dir=cache_dir)
    assert not outcome.accepted
    assert any("contradict one another" in item.text for item in outcome.findings)


def test_offset_of_the_reference_sensor(sensor, cache_dir, described):
    offset = np.array([0.05, 0.0, -0.1])
    samples = [replace(item, force=item.force + offset) for item in described]
    outcome = fit_material(sensor, samples, "force_sensor", POISSON_KNOWN, cache_dir=cache_dir)
    assert outcome.accepted, outcome.findings
    assert outcome.sensor.elastomer.young == pytest.approx(5e5, rel=0.03)
    np.testing.assert_allclose(outcome.offset, offset, atol=0.015)
    assert (np.abs(outcome.offset - offset) < 4 * outcome.offset_std).all()


def test_large_strain_is_taken_off(sensor, model, cache_dir):
    """A neo-Hookean gel that is described a fifth too stiff, under 1.5 N on a patch of 3 mm."""
    force = 3 * loads(model.elastic.nodes.points)["press"]
    gel = sensor.elastomer
    press = LargePress(ElasticProblem.from_sensor(sensor), gel.young, cache_dir)
    excess = press.excess(force)
    moved = model.elastic.displacement(force) + excess
    assert np.abs(excess).max() > 0.03 * np.abs(moved).max()
    layer = replace(gel.shading_layer, young=1.2 * gel.young)
    gel = replace(gel, model="neo_hookean", young=1.2 * gel.young, shading_layer=layer)
    sensor = replace(sensor, elastomer=gel)
    samples = [sample(moved, force.sum(axis=0), 3)]
    outcome = fit_material(sensor, samples, "weights", POISSON_KNOWN, cache_dir=cache_dir)
    assert outcome.accepted, outcome.findings
    assert outcome.sensor.elastomer.young == pytest.approx(5e5, rel=0.01)
    assert not any("linear" in item.text for item in outcome.findings)


@pytest.mark.parametrize(
    ("model", "large_press", "warned"),
    [
        ("linear", "auto", True),
        ("neo_hookean", "off", True),
        ("neo_hookean", "auto", False),
        ("linear", "on", False),
    ],
)
def test_presses_that_are_too_deep_for_a_linear_gel(sensor, model, large_press, warned):
    sensor = replace(
        sensor,
        elastomer=replace(sensor.elastomer, model=model),
        force=replace(sensor.force, large_press=large_press),
    )
    deep = np.full((20, 20, 3), [0.0, 0.0, -0.6e-3])
    for displacement, expected in ((deep, warned), (deep / 10, False)):
        found = load_findings(sensor, [replace(GOOD, displacement=displacement)])
        text = " ".join(item.text for item in found)
        assert bool(re.search("10.0% of its thickness.*wrong by up to 5%", text)) == expected


def test_the_modulus_makes_the_readings_right_and_their_spread_is_kept():
    """Readings 2 % high along z, one more and one less, and those sideways another 3 % high."""
    reference = np.array([[0.0, 0.0, -1.0], [0.3, 0.4, -2.0], [np.nan, np.nan, -4.0]])
    shown = np.nan_to_num(reference) * [1.0506, 1.0506, 1.02] * [[1.01], [1.0], [0.99]]
    sure = np.full((3, 3), 1e-6)
    readings, doubt = Readings(shown, sure, reference, sure), PoissonDoubt(0.0, 0.05)
    fit = fit_scale(readings, doubt, has_offset=False)
    assert fit.factor == pytest.approx(1 / 1.02, rel=0.01)
    # Two of three loads are off by 1 %; half a percent of model error.
    assert fit.std == pytest.approx(np.hypot(0.01, 0.006), rel=0.15)
    assert fit.sideways_std == pytest.approx(np.hypot(fit.std, np.hypot(0.05, 0.03)), rel=0.1)
    # References that may themselves be off so much explain the spread, and show nothing of it.
    unsure = replace(readings, reference_std=0.1 * np.abs(np.nan_to_num(reference)) + 1e-6)
    fit = fit_scale(unsure, doubt, has_offset=False)
    assert fit.sideways_std == pytest.approx(np.hypot(fit.std, 0.05))


def turned(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    ("change", "finding"),
    [
        (-np.eye(3), "has the wrong sign"),
        (turned(180), "sideways forces have another direction"),
        (turned(90), "sideways forces have another direction"),
    ],
)
def test_reference_in_another_frame(sensor, cache_dir, described, change, finding):
    """One clear finding, and the description as it was."""
    samples = [replace(item, force=change @ item.force) for item in described]
    outcome = fit_material(sensor, samples, "weights", POISSON_KNOWN, cache_dir=cache_dir)
    assert not outcome.accepted
    assert len(outcome.findings) == 1
    assert re.search(finding, outcome.findings[0].text)
    assert outcome.sensor is sensor
    assert outcome.record is None


def test_nothing_that_touches(sensor, cache_dir):
    samples = [sample(np.zeros((20, 20, 3)), np.array([0.0, 0.0, -0.5]), 0)]
    outcome = fit_material(sensor, samples, "weights", POISSON_KNOWN, cache_dir=cache_dir)
    assert not outcome.accepted
    assert outcome.findings[0].severity is Severity.ERROR
    assert "measures no contact" in outcome.findings[0].text
    assert outcome.loads[0].reason


def test_one_press_is_enough_and_is_said_to_be_little(sensor, cache_dir, described):
    outcome = fit_material(sensor, described[:1], "weights", POISSON_KNOWN, cache_dir=cache_dir)
    assert outcome.accepted
    texts = " ".join(item.text for item in outcome.findings)
    assert "only one load" in texts
    assert "All loads are presses" in texts


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
        (
            [replace(GOOD, force=np.full(3, np.nan))],
            "weights",
            "expected numbers, or NaN",
        ),
        ([replace(GOOD, std=np.zeros(3))], "weights", r"std: found \[0, 0, 0\], expected a number"),
    ],
)
def test_what_cannot_be_used_is_named(sensor, samples, method, message):
    with pytest.raises(CalibrationError, match=f"sample_rig: .*{message}"):
        fit_material(sensor, samples, method)


def test_small_loads_whose_noise_hides_them_do_not_widen_the_error_bar():
    reference = np.zeros((12, 3))
    reference[:, 2] = -np.linspace(2.0, 7.0, 12)
    reference[0, 2] = -0.02
    noise = np.random.default_rng(5).normal(0, 0.1, 12)
    noise[0] = 0.2
    readings = Readings(
        shown=reference + noise[:, None] * [0, 0, 1],
        shown_std=np.full((12, 3), 1e-3),
        reference=reference,
        reference_std=np.full((12, 3), 0.1),
    )
    fit = fit_scale(readings, PoissonDoubt(0.0, 0.0), has_offset=True)
    assert fit.factor == pytest.approx(1.0, abs=0.03)
    assert abs(fit.factor - 1) < 3 * fit.std < 0.1
