"""Gels that relax, simulated: closed forms, and the filter that undoes it in the force stage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.elastic.relaxation import RelaxationFilter
from cmp_tactile_processing.sensor.parts import GelRelaxation
from cmp_tactile_simulation.contact.laws import ContactState, Pose
from cmp_tactile_simulation.live.mechanics import LiveSettings, stay, step_towards
from cmp_tactile_simulation.scenes.simulation import Simulation

SHARE, TIME = 0.3, 0.2
# The contact's residual, indentation.DEFECT, to the press of 0.6 mm, with room.
RTOL_SOLVER = 3e-6
# Steps of 1/200 of the time constant.
RTOL_STEPS = 1e-5
# Rounding of displacements of 0.5 mm.
ATOL_ROUNDING_M = 1e-11

PRESS = {"name": "press", "frames": 1, "by": {"position": [0, 0, -0.0006]}}
STAY = {"name": "stay", "frames": 20, "hold": True}
WEIGHT = {"normal": 0.6, "tangential": [0.1, 0]}
HANDLING = [
    {"name": "press", "frames": 4, "by": {"position": [0, 0, -0.0006]}},
    {"name": "drag", "frames": 4, "by": {"position": [0.0004, 0, 0]}},
    {"name": "load", "frames": 2, "load": WEIGHT},
    {"name": "keep", "frames": 2, "load": WEIGHT},
    {"name": "lift", "frames": 3, "by": {"position": [0, 0, 0.0009]}},
    {"name": "stay", "frames": 3, "hold": True},
]


@pytest.fixture(scope="module")
def simulated(small_scene):
    """Makes the small scene with another motion and a gel that relaxes, or not."""

    def make(motion, relaxes=True) -> Simulation:
        scene = small_scene(motion=motion)
        relaxation = GelRelaxation(SHARE, TIME) if relaxes else None
        elastomer = replace(scene.sensor.elastomer, relaxation=relaxation)
        return Simulation(replace(scene, sensor=replace(scene.sensor, elastomer=elastomer)))

    return make


def contacts(simulation) -> list[ContactState]:
    return [state.contact for state in simulation.states()]


def test_a_gel_that_is_held_loses_its_force_as_its_modulus_does(simulated):
    gel = simulated([PRESS, STAY])
    held = contacts(gel)
    elastic = contacts(simulated([PRESS], relaxes=False))[0]
    step = 1 / gel.scene.rate
    # Convolution of the modulus with a force that grows along a line over the first frame.
    ramp = TIME / step * np.expm1(step / TIME)
    time = step * np.arange(1, len(held) + 1)
    expected = 1 - SHARE + SHARE * ramp * np.exp(-time / TIME)
    for share, state in zip(expected, held, strict=True):
        np.testing.assert_allclose(
            state.force, share * elastic.force, rtol=0, atol=RTOL_SOLVER * abs(elastic.force).max()
        )
        np.testing.assert_array_equal(state.contact, elastic.contact)


def test_a_gel_under_a_weight_yields_as_its_creep_compliance(simulated):
    """Constant forces in fine steps, against the closed form of the creep of one Prony term."""
    gel = simulated([PRESS]).elastomer
    rng = np.random.default_rng(0)
    force = rng.normal(0, 0.1, gel.node_position.shape)
    elastic = gel.elastic.displacement(force)
    step, count = TIME / 200, 600
    for index in range(count):
        gel.advance(force * (index > 0), step)
    time = step * (np.arange(count) + 0.5)[-1]
    creep = 1 + SHARE / (1 - SHARE) * -np.expm1(-(1 - SHARE) * time / TIME)
    # The load grows over the first step, which is second order in its length.
    np.testing.assert_allclose(gel.displacement(force), creep * elastic, rtol=RTOL_STEPS)
    gel.forget()
    np.testing.assert_allclose(gel.displacement(force), elastic, rtol=1e-12)


def test_the_filter_finds_the_elastic_displacement_through_a_whole_handling(simulated):
    """Press, slip, constant load, release and the dent that is left."""
    gel = simulated(HANDLING)
    observers = gel.elastomer.observers
    status = np.ones((observers.rows, observers.cols), np.uint8)
    undone = RelaxationFilter(gel.scene.sensor.elastomer.relaxation)
    undone.effective(np.zeros((*status.shape, 3)), status, 0)
    elastic = simulated(HANDLING, relaxes=False).elastomer
    largest = 0.0
    for frame, state in enumerate(gel.states()):
        moved = gel.elastomer.marker_displacement(state.contact.force)
        stamp = gel.scene.stamp_ns(frame) - gel.scene.stamp_ns(0) + round(1e9 / gel.scene.rate)
        found = undone.effective(moved, status, stamp)
        expected = elastic.marker_displacement(state.contact.force)
        # Stamps are whole ns, of a frame of 33 ms.
        np.testing.assert_allclose(found, expected, rtol=0, atol=ATOL_ROUNDING_M)
        largest = max(largest, np.abs(moved - expected).max())
    assert largest > 5e-5, "the gel did not relax: the filter had nothing to do"
    assert not state.contact.contact.any()
    assert np.abs(moved).max() > 5e-5, "a gel that was just let go still has its dent"


def test_a_live_gel_that_is_held_relaxes_in_real_time(simulated):
    """Whatever the steps' lengths: 0.5 s at once or in pieces."""
    gel = simulated([PRESS])
    now = gel.start().contact
    pressed, there = step_towards(
        gel, now, Pose(now.pose.position - [0, 0, 6e-4], now.pose.rotation), LiveSettings(), 0.06
    )
    assert there
    elapsed = [0.01, 0.09, 0.2, 0.2]
    held = pressed
    for seconds in elapsed:
        held = stay(gel, held, seconds)
    # Loaded along a line over 0.06 s, held for 0.5 s.
    ramp = TIME / 0.06 * np.expm1(0.06 / TIME)
    after = [1 - SHARE + SHARE * ramp * np.exp(-t / TIME) for t in (0.06, 0.06 + sum(elapsed))]
    found = held.resultant[2] / pressed.resultant[2]
    assert found == pytest.approx(after[1] / after[0], rel=RTOL_SOLVER)
