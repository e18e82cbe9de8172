"""Recordings: packaged scenes by name, simulated bags with their truth, bad ones named."""

import shutil

import pytest

from cmp_tactile_bringup.recordings.library import (
    is_packaged,
    recorded_source,
    required_sensor,
    sensor_of_recording,
    sensor_of_recordings,
    sensor_of_scene,
)
from cmp_tactile_bringup.report.results import find_recording
from cmp_tactile_processing.errors import FrameSourceError, InputError, OutputError
from cmp_tactile_processing.sensor.description import load_sensor, packaged_sensors
from cmp_tactile_simulation.scenes.file import load_scene


def test_a_recording_has_the_title_and_the_phases_of_its_scene(recording):
    assert recording.title == "Short grasp of a hex key with a knock"
    phases = {phase.name: phase.first_frame for phase in recording.phases}
    assert (len(phases), phases["rest"], phases["knock"], phases["rest again"]) == (8, 0, 10, 18)


def test_a_packaged_scene_is_recorded_when_it_is_named(short_scenes, grasp_bag, tmp_path):
    assert recorded_source(tmp_path / "grasp") == tmp_path / "grasp"
    steps = []
    found = find_recording("grasp", lambda *progress: steps.append(progress))
    assert found.bag == grasp_bag
    assert steps == []  # it was in the cache


def test_a_file_of_a_scenes_name_is_taken_for_what_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert is_packaged(tmp_path.relative_to(tmp_path) / "grasp")
    (tmp_path / "grasp").mkdir()
    assert not is_packaged(tmp_path.relative_to(tmp_path) / "grasp")


def test_the_sensor_of_a_scene_is_a_file_that_can_be_loaded():
    assert sensor_of_scene("grasp") == sensor_of_recording("grasp")
    assert sensor_of_scene("grasp").endswith("/sample_rig.yaml")
    for name in ("ball:10mm", "precision_sphere"):
        described = load_sensor(sensor_of_scene(name))
        assert described.elastomer == load_scene(name).sensor.elastomer
    with pytest.raises(InputError, match="nosuch"):
        sensor_of_scene("nosuch")


def test_the_sensor_lies_beside_the_bag_unless_it_is_given(grasp_bag, tmp_path):
    assert required_sensor(grasp_bag, None) == str(grasp_bag / "sensor.yaml")
    assert required_sensor(grasp_bag, "prototype") == "prototype"
    with pytest.raises(FrameSourceError, match=r"found no --sensor, expected .*prototype"):
        required_sensor(tmp_path / "0.png", None)


@pytest.mark.parametrize("name", ["bag_0.mcap", "bag_0.db3", "0.png"])
def test_the_sensor_beside_a_file_is_that_of_its_folder(tmp_path, name):
    (tmp_path / name).write_bytes(b"")
    beside = tmp_path / "sensor.yaml"
    shutil.copy(packaged_sensors()["sample_rig"], beside)
    assert required_sensor(tmp_path / name, None) == required_sensor(tmp_path, None) == str(beside)


def test_a_folder_without_a_recording_is_said_to_hold_what_it_holds(grasp_bag, tmp_path):
    """Before a sensor is asked for, which would not help."""
    with pytest.raises(FrameSourceError, match="found nothing, expected the files of a bag"):
        required_sensor(tmp_path, None)
    (tmp_path / "notes.txt").touch()
    (tmp_path / "first").symlink_to(grasp_bag)
    found = r"found first/, notes.txt, expected .*; the folder contains bags, such as .*/first/?$"
    with pytest.raises(FrameSourceError, match=found):
        required_sensor(tmp_path, None)
    (tmp_path / "0.png").touch()
    with pytest.raises(FrameSourceError, match="found no --sensor"):
        required_sensor(tmp_path, None)


def test_recordings_of_one_replay_have_one_sensor(grasp_bag, tmp_path):
    copy, other = tmp_path / "copy", tmp_path / "other"
    text = (grasp_bag / "sensor.yaml").read_text()
    for folder, sensor in ((copy, f"# The same.\n{text}"), (other, f"{text}\nelse: 1\n")):
        folder.mkdir()
        (folder / "sensor.yaml").write_text(sensor)
    assert sensor_of_recordings([tmp_path, copy, grasp_bag]) == str(copy / "sensor.yaml")
    assert sensor_of_recordings([]) == ""
    with pytest.raises(FrameSourceError, match="other: found another sensor description, expected"):
        required_sensor(grasp_bag, None, copy, other)
    assert required_sensor(grasp_bag, "prototype", other) == "prototype"


@pytest.fixture
def copied(tmp_path, grasp_bag):
    """A copy of the recording."""
    return shutil.copytree(grasp_bag, tmp_path / "copy")


@pytest.mark.parametrize("name", ["metadata.yaml", "scene.yaml", "sensor.yaml"])
def test_what_is_no_simulated_recording_names_what_it_lacks(copied, name):
    with pytest.raises(FrameSourceError, match=r"nosuch: found no metadata\.yaml"):
        find_recording("nosuch")
    (copied / name).unlink()
    with pytest.raises(FrameSourceError, match=f"copy: found no {name}, expected a recording"):
        find_recording(str(copied))


def test_wrong_files_beside_the_bag_are_named(copied):
    sensor, scene = copied / "sensor.yaml", copied / "scene.yaml"
    good = sensor.read_text()
    sensor.write_text(good + "colour: blue\n")
    with pytest.raises((InputError, InputError), match="colour"):
        find_recording(str(copied))
    sensor.write_text(good)
    scene.write_text(scene.read_text() + "colour: blue\n")
    with pytest.raises(InputError, match=r"scene\.yaml:\d+: colour"):
        find_recording(str(copied))


def test_a_damaged_bag_is_named(copied):
    for path in copied.glob("*.mcap"):
        path.write_bytes(b"no bag")
    with pytest.raises((FrameSourceError, OutputError), match="copy"):
        find_recording(str(copied))
