"""Live motion: in real time along a scene, at a limited rate towards targets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cmp_tactile_processing.errors import ContactError
from cmp_tactile_simulation.contact.laws import Load, Pose
from cmp_tactile_simulation.live.mechanics import LiveSettings, ScenePlayer, step_towards
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.scenes.simulation import Simulation

SCENE = Path(__file__).parents[1] / "data" / "live_press.yaml"
FRAME_S = 1 / 50


@pytest.fixture(scope="module")
def simulation():
    return Simulation(load_scene(str(SCENE)))


def test_the_scene_plays_in_its_own_time_and_begins_again(simulation):
    player = ScenePlayer(simulation)
    offline = [state.contact.pose.position for state in simulation.states()]
    live = [player.step(FRAME_S).pose.position for _ in range(simulation.scene.frame_count)]
    np.testing.assert_allclose(live, offline, atol=1e-12)
    np.testing.assert_allclose(player.step(FRAME_S).pose.position, player.start().pose.position)
    assert not player.contact.contact.any()


def test_a_long_step_plays_all_frames_that_are_due(simulation):
    player = ScenePlayer(simulation)
    offline = [state.contact.pose.position for state in simulation.states()]
    for frame in (3, 7, 11):
        np.testing.assert_allclose(player.step(4 * FRAME_S).pose.position, offline[frame])


def test_a_frame_that_cannot_be_solved_is_passed_over(simulation, monkeypatch):
    player = ScenePlayer(simulation)
    good = player.step(FRAME_S)
    with monkeypatch.context() as broken:
        broken.setattr(simulation.contact, "move", _raise_contact_error)
        with pytest.raises(ContactError, match="not solved"):
            player.step(FRAME_S)
        assert player.contact is good
    after = player.step(FRAME_S)
    expected = list(simulation.states())[2].contact.pose.position
    np.testing.assert_allclose(after.pose.position, expected, atol=1e-12)


def _raise_contact_error(*_):
    raise ContactError("not solved")


def test_a_target_is_approached_at_the_speed_that_is_allowed(simulation):
    settings = LiveSettings(max_speed=0.01)
    now = simulation.start().contact
    target = Pose(now.pose.position + (0.0, 3e-4, -4e-4), now.pose.rotation)
    steps = []
    for _ in range(3):
        before = now
        now, there = step_towards(simulation, now, target, settings, 0.02)
        steps.append((np.linalg.norm(now.pose.position - before.pose.position), there))
    # 0.5 mm at 10 mm/s, 0.2 mm a step.
    assert [there for _, there in steps] == [False, False, True]
    assert [length for length, _ in steps] == pytest.approx([2e-4, 2e-4, 1e-4])
    np.testing.assert_allclose(now.pose.position, target.position, atol=1e-12)


def test_a_load_grows_at_the_rate_that_is_allowed_and_is_reached(simulation):
    settings = LiveSettings(max_load_rate=10.0)
    now, there = simulation.start().contact, False
    forces = []
    while not there and len(forces) < 10:
        now, there = step_towards(simulation, now, Load(normal=1.0), settings, elapsed=0.04)
        forces.append(-now.resultant[2])
    # To the load control's own tolerance, far below a percent.
    assert forces == pytest.approx([0.4, 0.8, 1.0], rel=0.01)
