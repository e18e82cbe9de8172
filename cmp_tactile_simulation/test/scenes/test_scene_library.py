"""Every packaged scene loads, says where it comes from, and can be simulated."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh

from cmp_tactile_processing.errors import InputError
from cmp_tactile_simulation.scenes.file import load_scene, packaged_scene_names
from cmp_tactile_simulation.scenes.simulation import Simulation
from cmp_tactile_simulation.scenes.table import renew

# A third of the probe's, so that its points lie on nodes here too.
COARSE_NODES = 21
REPOSITORY = Path(__file__).parents[3]
DOCUMENT = REPOSITORY / "docs" / "scenes.md"
NAMES = list(packaged_scene_names())


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_says_what_it_is(name):
    scene = load_scene(name)
    assert scene.name == name.replace(":", "_")
    assert scene.source == "daily life" or scene.source.startswith("paper, section ")
    assert scene.title
    assert scene.note


def shortened(scene):
    """The scene in few frames on a coarse mesh; of equal phases of a group only the first.

    The gel is linear: the other model takes minutes here, and has tests of its own.
    """
    kinds = {}
    for phase in scene.motion:
        kinds.setdefault(phase.name.rstrip("0123456789 "), phase)
    motion = tuple(dataclasses.replace(phase, frames=1) for phase in kinds.values())
    gel = dataclasses.replace(scene.sensor.elastomer, model="linear")
    sensor = dataclasses.replace(scene.sensor, elastomer=gel)
    return dataclasses.replace(scene, sensor=sensor, motion=motion, contact_nodes=COARSE_NODES)


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_can_be_simulated(name):
    pressed = 0.0
    for state in Simulation(shortened(load_scene(name))).states():
        assert np.isfinite(state.contact.displacement).all()
        pressed = max(pressed, -float(state.contact.resultant[2]))
    assert pressed > 0.05


def test_the_grasps_knock_moves_the_gel_by_more_than_two_checkers_in_one_frame():
    scene = load_scene("grasp")
    names = [phase.name for phase in scene.motion]
    knock = scene.motion[names.index("knock")]
    assert (scene.frame_count, scene.rate, knock.frames) == (60, 30.0, 1)
    moved = {}
    simulation = Simulation(dataclasses.replace(scene, contact_nodes=24))
    for state in simulation.states():
        moved[state.frame] = simulation.elastomer.marker_displacement(state.contact.force)
        if state.frame == 32:
            break
    jump = np.linalg.norm(moved[32] - moved[31], axis=-1).max()
    assert jump > 2 * scene.sensor.pattern.pitch


@pytest.mark.parametrize("text", ["nothing", "nothing:10mm", "no/such.yaml", ":"])
def test_an_unknown_scene_is_answered_with_the_known_ones(text):
    with pytest.raises(InputError, match=r"found no such scene, expected a file or one of ball, "):
        load_scene(text)


def test_a_scene_of_several_variants_needs_one():
    expected = r"variants: found nothing, expected one of 10mm, .*20mm, given as SCENE:10mm"
    with pytest.raises(InputError, match=expected):
        load_scene("ball")


def test_the_documents_tables_are_made_from_the_code():
    assert DOCUMENT.read_text() == renew(DOCUMENT), (
        "run: python3 -m cmp_tactile_simulation.scenes.table docs/scenes.md"
    )


def test_the_documents_example_can_be_simulated(tmp_path):
    example = DOCUMENT.read_text().split("```yaml")[1].split("```")[0]
    (tmp_path / "thimble.yaml").write_text(example)
    trimesh.creation.icosphere(3, 8.0).export(tmp_path / "thimble.stl")
    scene = load_scene(str(tmp_path / "thimble.yaml"))
    assert scene.frame_count == 5 + 15 + 15 + 9
    *_, last = Simulation(shortened(scene)).states()
    assert not last.contact.contact.any()
