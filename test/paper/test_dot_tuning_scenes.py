"""The dot methods are not tuned on what they are judged by."""

from __future__ import annotations

from cmp_tactile_simulation.scenes.library import load_scene
from paper.balls import DIAMETERS_MM
from paper.dot_tuning_scenes import TUNING_SEQUENCES, tuning_scenes

JUDGED = (
    "contact_sphere",
    "contact_cube_edge",
    "contact_cylinder",
    "contact_hexagonal_bar",
    "contact_ring",
    "precision_sphere",
    "resolution_spheres",
    "probe",
    "grasp",
)


def test_no_tuning_scene_has_the_indenter_of_an_experiment() -> None:
    judged = [load_scene(name).indenter for name in JUDGED]
    shapes = {(indenter.type, repr(dict(indenter.values))) for indenter in judged}
    assert len(shapes) == len(JUDGED)
    balls = [load_scene(f"ball:{diameter}mm").indenter for diameter in DIAMETERS_MM]
    shapes |= {(ball.type, repr(dict(ball.values))) for ball in balls}
    for scene in tuning_scenes().values():
        assert (scene.indenter.type, repr(dict(scene.indenter.values))) not in shapes


def test_sequences_begin_at_rest_and_name_frames_that_there_are() -> None:
    scenes = tuning_scenes()
    for scene, frames in TUNING_SEQUENCES.values():
        assert frames[0] == 0
        assert list(frames) == sorted(set(frames))
        assert frames[-1] < scenes[scene].frame_count
