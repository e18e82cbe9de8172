"""Scene files: what they say is what is read, and each mistake is one line that names it."""

from __future__ import annotations

import re

import pytest
import yaml

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_simulation.contact.laws import Load
from cmp_tactile_simulation.scenes.description import Hold, MoveBy, MoveTo, Press, Release, Touch
from cmp_tactile_simulation.scenes.file import read_scene, variants_of, write_scene

SCENE = """
version: 1
name: press
sensor: sample_rig
indenter: {type: sphere, radius: 0.004}
rate: 20
start: {position: [0, 0, 0.005]}
motion:
  - {name: down, duration: 0.5, to: {position: [0, 0, 0.004]}}
"""


@pytest.fixture
def write(tmp_path):
    """Writes the scene with some keys changed; None removes a key."""

    def write(changes=None, text=SCENE):
        content = yaml.safe_load(text)
        for key, value in (changes or {}).items():
            if value is None:
                del content[key]
            else:
                content[key] = value
        path = tmp_path / "scene.yaml"
        path.write_text(yaml.safe_dump(content, sort_keys=False))
        return path

    return write


def test_a_scene_is_what_its_file_says(write):
    scene = read_scene(write())
    assert (scene.name, scene.rate, scene.frame_count) == ("press", 20.0, 10)
    assert (scene.title, scene.source) == ("press", "")
    assert scene.sensor.elastomer == load_sensor("sample_rig").elastomer
    assert scene.indenter.values == {"radius": 0.004}
    assert scene.start.place == (0.0, 0.0, 0.005)
    assert scene.motion[0].goal == MoveTo((0.0, 0.0, 0.004), None)
    assert scene.stamp_ns(10) - scene.stamp_ns(0) == 500_000_000


def test_every_kind_of_phase_is_read(write):
    phases = [
        {"name": "a", "frames": 1, "hold": True},
        {"name": "b", "frames": 2, "to": {"rotation_deg": [0, 0, 200]}, "easing": "linear"},
        {"name": "c", "frames": 3, "by": {"position": [0, 0.001, 0], "rotation_deg": [1, 0, 0]}},
        {"name": "d", "frames": 4, "load": {"normal": 2, "tangential": [1, 0], "torque": 0.01}},
        {"name": "e", "frames": 5, "touch": {"at": [0.001, 0], "clearance": 0.002}},
        {"name": "f", "frames": 6, "release": 0.003},
    ]
    motion = read_scene(write({"motion": phases})).motion
    assert [phase.goal for phase in motion] == [
        Hold(),
        MoveTo(None, (0.0, 0.0, 200.0)),
        MoveBy((0.0, 0.001, 0.0), (1.0, 0.0, 0.0)),
        Press(Load(2.0, (1.0, 0.0), 0.01)),
        Touch((0.001, 0.0), 0.002),
        Release(0.003),
    ]
    assert [phase.frames for phase in motion] == [1, 2, 3, 4, 5, 6]
    assert [phase.easing for phase in motion[:3]] == ["smooth", "linear", "smooth"]


def test_groups_are_played_at_each_point_and_as_often_as_they_say(write):
    inner = [{"name": "over", "frames": 1, "touch": {"clearance": 0.001}}]
    again = [{"name": "wait", "frames": 1, "hold": True}]
    groups = [
        {"points": [[0, 0], [0.001, 0.002]], "motion": inner},
        {"repeat": 2, "motion": again},
    ]
    motion = read_scene(write({"motion": groups})).motion
    assert [phase.name for phase in motion] == ["over 1", "over 2", "wait 1", "wait 2"]
    assert [phase.goal.at for phase in motion[:2]] == [(0, 0), (0.001, 0.002)]


def test_the_sensor_is_a_base_with_keys_laid_over_it(write, tmp_path):
    sensor = {"base": "sample_rig", "name": "stiff", "elastomer": {"young": 2e6}}
    scene = read_scene(write({"sensor": sensor}))
    assert (scene.sensor.name, scene.sensor.elastomer.young) == ("stiff", 2e6)
    assert scene.sensor.elastomer.poisson == load_sensor("sample_rig").elastomer.poisson
    write_scene(scene, tmp_path)
    again = SensorDescription.load(tmp_path / "sensor.yaml")
    assert (again.name, again.elastomer, again.camera) == (
        "stiff",
        scene.sensor.elastomer,
        scene.sensor.camera,
    )


def test_a_scene_written_out_again_is_the_same_scene(write, tmp_path):
    phases = [
        {"name": "turn", "frames": 3, "by": {"rotation_deg": [1.1, 2.2, 3.3]}},
        {"name": "press", "frames": 4, "load": {"normal": 0.1, "tangential": [0.1, 0.2]}},
        {"name": "next", "frames": 4, "touch": {"at": [0.1, 0.07]}},
        {"name": "stay", "frames": 1, "hold": True},
        {"name": "up", "frames": 1, "release": 0.003},
    ]
    changes = {
        "motion": phases,
        "camera": {"blur": 1.25, "glare_spots": 2},
        "print": {"missing_ink": 3},
        "start": {"touch": {"at": [0, 0.001]}, "rotation_deg": [0, 10, 0]},
        "indenter": {"type": "sphere_group", "radius": 0.001, "centres": [[0, 0, 0]]},
        "pattern_type": "dmp",
        "note": "why",
        "seed": 7,
    }
    scene = read_scene(write(changes))
    folder = tmp_path / "out"
    folder.mkdir()
    write_scene(scene, folder)
    again = read_scene(folder / "scene.yaml")
    for key in scene.__dataclass_fields__:
        if key != "sensor":
            assert getattr(again, key) == getattr(scene, key), key


def test_a_variant_is_laid_over_the_scene(write):
    variants = {"big": {"indenter": {"radius": 0.006}}, "small": {"indenter": {"radius": 0.002}}}
    path = write({"variants": variants})
    assert variants_of(path) == ("big", "small")
    scene = read_scene(path, "small")
    assert (scene.name, scene.indenter.values) == ("press_small", {"radius": 0.002})
    with pytest.raises(InputError, match=r"variants: found nothing, expected one of big, sm"):
        read_scene(path)
    with pytest.raises(InputError, match=r"variants: found 'huge', expected one of big, small"):
        read_scene(path, "huge")


PHASE = {"name": "p", "frames": 1}
MISTAKES = {
    "unknown key": ({"colour": "red"}, "colour: found 'red', expected no such key; allowed: "),
    "wrong kind": ({"rate": "fast"}, "rate: found 'fast', expected a number from 0.1 to 1000"),
    "sensor base": (
        {"sensor": {"base": "nope"}},
        "sensor.base: found 'nope', expected a sensor description",
    ),
    "sensor value": (
        {"sensor": {"base": "sample_rig", "elastomer": {"young": -1}}},
        "sensor.elastomer.young: found -1, expected a number from 1000",
    ),
    "indenter size": (
        {"indenter": {"type": "sphere", "radius": 5}},
        "indenter.radius: found 5, expected a number from 1e-06 to 0.2 m: did you mean 0.005?",
    ),
    "mesh": (
        {"indenter": {"type": "mesh", "file": "no.stl"}},
        "indenter.file: found 'no.stl', expected an existing file",
    ),
    "start": (
        {"start": {"rotation_deg": [0, 0, 0]}},
        "start: found {'rotation_deg': [0, 0, 0]}, expected either `position` or `touch`",
    ),
    "camera value": ({"camera": {"blur": -1}}, "camera.blur: found -1, expected a number from 0"),
    "both lengths": (
        {"motion": [PHASE | {"duration": 1, "hold": True}]},
        "motion[0]: found 'both', expected either `frames` or `duration`",
    ),
    "pull": (
        {"motion": [PHASE | {"load": {"normal": -1}}]},
        "motion[0].load.normal: found -1, expected a number from 0 to 1000",
    ),
    "half a turn": (
        {"motion": [PHASE | {"by": {"rotation_deg": [0, 0, 180]}}]},
        "motion[0].by.rotation_deg: found [0, 0, 180], expected a rotation of less than 180",
    ),
    "no way": (
        {"motion": [PHASE | {"by": {}}]},
        "motion[0].by: found {}, expected `position`, `rotation_deg` or both",
    ),
    "group": (
        {"motion": [{"motion": [PHASE]}]},
        "motion[0]: found 'a group', expected either `points` or `repeat` beside its `motion`",
    ),
    "inside a group": (
        {"motion": [{"repeat": 2, "motion": [PHASE | {"hold": 1}]}]},
        "motion[0].motion[0].hold: found 1, expected true or false",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_with_file_key_found_and_expected(mistake, write):
    changes, message = MISTAKES[mistake]
    path = write(changes)
    with pytest.raises(InputError, match=re.escape(f"{path}:") + r"\d+: " + re.escape(message)):
        read_scene(path)
