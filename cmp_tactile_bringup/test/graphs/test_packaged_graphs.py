"""The packaged graphs: what each is made of, RViz's settings for them, and their documents."""

import re
import runpy
from pathlib import Path

import pytest
import yaml

from cmp_tactile_bringup.graphs.description import (
    LAUNCH_ARGUMENTS,
    check_recordings,
    parameters_of_nodes,
    with_recordings,
)
from cmp_tactile_bringup.graphs.packaged import GRAPHS, load_graph
from cmp_tactile_bringup.graphs.rviz import rviz_settings, rviz_settings_file
from cmp_tactile_processing.errors import CmpTactileError, InputError

ROOT = Path(__file__).resolve().parents[3]
DOCUMENT = ROOT / "docs" / "launch.md"
ARGUMENTS = ROOT / "docs" / "launch_arguments.md"
TABLE = runpy.run_path(str(ROOT / "docs" / "argument_table.py"))
CHAIN = {
    "recorder",
    "surface_visualizer",
    "force_reconstructor",
    "stereo_triangulator",
    "left_gridline_tracker",
    "right_gridline_tracker",
    "view_splitter",
}
ONE_SENSOR = {
    "replay": ({}, {"replay"}),
    "simulate": ({}, {"camera_driver"}),
    "sensor": ({"sensor": "sample_rig", "device": "x"}, {"camera_driver"}),
}


def _load(graph, **given):
    return load_graph(graph, given)


@pytest.mark.parametrize("name", ONE_SENSOR)
def test_one_sensor_is_its_chain_and_a_source_that_comes_last(name):
    given, source = ONE_SENSOR[name]
    graph = _load(name, **given)
    names = [component.name for component in graph.components]
    assert set(names) == CHAIN | source
    assert names[-1] in source
    assert graph.namespace == "/sample_rig"


@pytest.mark.parametrize(("record", "output"), [("", ""), ("there", str(Path("there").resolve()))])
def test_a_recorder_without_a_folder_waits_for_its_service(record, output):
    """Reports: ros2/rosbag2 1130, 1131 (a recorder that is there and records when it is asked)."""
    for name, given in {**{n: g for n, (g, _) in ONE_SENSOR.items()}, "gripper": {}}.items():
        graph = _load(name, **given, record=record)
        recorders = [c.parameters for c in graph.components if c.name == "recorder"]
        assert len(recorders) == (2 if name == "gripper" else 1)
        for parameters in recorders:
            assert parameters["autostart"] == bool(record)
            assert parameters["output"].startswith(output)


def test_a_sensor_without_a_camera_has_no_camera_nodes():
    graph = _load("sensor", source="topic", sensor="tac3d_ad2")
    names = {component.name for component in graph.components}
    assert names == {"force_reconstructor", "surface_visualizer", "recorder"}
    mounted = _load("sensor", source="topic", sensor="tac3d_ad2", parent_frame="hand")
    # It sends the transform of the mount.
    assert {component.name for component in mounted.components} == names | {"view_splitter"}


@pytest.mark.parametrize(
    ("given", "awaited"),
    [
        ({}, 1),
        ({"record": "there"}, 2),
        ({"record": "there", "record_topics": "/sample_rig/* wrench"}, 2),
        ({"record": "there", "record_topics": "force_field"}, 1),
    ],
)
def test_a_replay_waits_for_the_recorder_of_its_frames(given, awaited):
    """Reports: ros2/rosbag2 1430, 2318 (what is sent before the recorder subscribes is missing);
    tried: the bag has every frame.
    """
    graph = _load("replay", sensor="sample_rig", **given)
    assert graph.components[-1].parameters["wait_for_subscribers"] == awaited


def test_a_sensor_has_the_namespace_and_the_name_that_it_is_given():
    assert _load("replay", sensor="prototype").namespace == "/prototype"
    assert _load("replay", namespace="hand/left").namespace == "/hand/left"
    absolute = _load("replay", namespace="/hand/left")
    assert {component.namespace for component in absolute.components} == {"/hand/left"}
    for name, value in (("name", "a b"), ("namespace", "a-b"), ("namespace", "a__b")):
        with pytest.raises(InputError, match=f"argument {name}: found '{value}', expected "):
            _load("replay", **{name: value})


def test_a_recording_brings_the_sensor_beside_it(grasp_bag, tmp_path):
    graph = _load("replay", input=str(grasp_bag))
    assert graph.sensors[0].description == (grasp_bag / "sensor.yaml").resolve()
    assert graph.components[-1].parameters["input"] == str(grasp_bag.resolve())
    with pytest.raises(InputError, match="argument sensor: found nothing, expected the file of a"):
        _load("replay", input=str(tmp_path))
    # What is not there is named before its sensor.
    message = "argument left_input: /nowhere: found no such file or folder, expected a ROS 2 bag"
    with pytest.raises(InputError, match=message):
        _load("gripper", left_source="replay", left_input="/nowhere")


def test_a_gripper_has_two_sensors_with_sources_of_their_own():
    graph = _load("gripper", left_source="replay", right_source="v4l2", right_sensor="prototype")
    assert [(s.name, s.namespace, s.description.stem) for s in graph.sensors] == [
        ("left_finger", "/left_finger", "sample_rig"),
        ("right_finger", "/right_finger", "prototype"),
    ]
    sources = [c.full_name for c in graph.components[-2:]]
    assert sources == ["/left_finger/replay", "/right_finger/camera_driver"]
    assert graph.components[-1].parameters["source"] == "v4l2"
    for finger in ("left_finger", "right_finger"):
        parts = [c for c in graph.components if c.namespace == f"/{finger}"]
        assert {c.name for c in parts} > CHAIN
        assert {c.parameters["sensor_name"] for c in parts} == {finger}
    parts = graph.by_process()
    assert [part.namespace for part in parts] == ["/left_finger", "/right_finger"]
    # It has no sensor, and still there are two processes.
    assert "/grasp_state" in [c.full_name for c in parts[0].components]
    assert sorted(c.full_name for part in parts for c in part.components) == sorted(
        c.full_name for c in graph.components
    )


def test_the_state_of_a_grasp_is_that_of_both_fingers_where_they_are_mounted():
    (state,) = (c for c in _load("gripper").components if c.sensor is None)
    assert state.remappings == {
        "left/force_field": "/left_finger/force_field",
        "right/force_field": "/right_finger/force_field",
    }
    assert state.parameters == {"use_sim_time": False, "frame": "gripper"}
    given = {"namespace": "hand", "left_name": "thumb", "left_parent_frame": "tool"}
    graph = _load("gripper", **given)
    (state,) = (c for c in graph.components if c.sensor is None)
    assert state.full_name == "/hand/grasp_state"
    assert state.remappings["left/force_field"] == "/hand/thumb/force_field"
    assert state.parameters["frame"] == "tool"
    assert "Value: /hand/grasp_markers\n" in rviz_settings(graph)
    without = _load("gripper", grasp_state="false").components
    assert [c.name for c in without if c.sensor is None] == []


def test_the_fingers_of_a_gripper_face_one_another():
    mounts = {
        c.namespace: (c.parameters["mount_position"], c.parameters["mount_orientation"])
        for c in _load("gripper").components
        if c.name == "view_splitter"
    }
    assert mounts["/left_finger"] == ([0.0, 0.02, 0.0], [1.5707963, 0.0, 0.0])
    assert mounts["/right_finger"] == ([0.0, -0.02, 0.0], [-1.5707963, 0.0, 0.0])
    given = _load("gripper", left_parent_frame="tool", left_mount="1 2 3 0.1 0.2 0.3")
    (left, _) = (c for c in given.components if c.name == "view_splitter")
    assert left.parameters["parent_frame"] == "tool"
    assert left.parameters["mount_position"] == [1.0, 2.0, 3.0]
    assert left.parameters["mount_orientation"] == [0.1, 0.2, 0.3]
    (loose, _) = (
        c for c in _load("gripper", left_parent_frame="").components if c.name == left.name
    )
    assert loose.parameters["mount_position"] == [0.0, 0.0, 0.0]


def test_a_gripper_plays_two_bags_in_step_and_records_two(tmp_path):
    common = {"left_source": "replay", "right_source": "replay", "rate": "0.5", "loop": "true"}
    graph = _load("gripper", **common, record=str(tmp_path / "run"))
    replays = [c.parameters for c in graph.components if c.name == "replay"]
    assert [(p["rate"], p["loop"]) for p in replays] == [(0.5, True), (0.5, True)]
    # Two clocks would contradict each other.
    assert [p["publish_clock"] for p in replays] == [True, False]
    outputs = [c.parameters["output"] for c in graph.components if c.name == "recorder"]
    assert outputs == [f"{tmp_path}/run/left_finger", f"{tmp_path}/run/right_finger"]


@pytest.mark.usefixtures("short_scenes", "grasp_bag")
def test_replays_of_one_graph_begin_together():
    graph = _load("gripper", left_source="replay", right_source="replay")
    replays = [c for c in with_recordings(graph).components if c.name == "replay"]
    assert [replay.parameters["begin_with"] for replay in replays] == [
        "/right_finger/replay",
        "/left_finger/replay",
    ]
    one = with_recordings(_load("gripper", left_source="replay"))
    assert [c.name for c in one.components if "begin_with" in c.parameters] == []


@pytest.mark.parametrize(
    ("name", "given", "by_clock"),
    [
        ("replay", {}, True),
        ("simulate", {}, False),
        ("sensor", {"sensor": "sample_rig"}, False),
        ("sensor", {"sensor": "sample_rig", "source": "topic", "use_sim_time": "true"}, True),
    ],
)
def test_time_is_that_of_the_clock_where_a_recording_is_played(name, given, by_clock, tmp_path):
    """All nodes alike; markers of a replay stay though no new ones come."""
    graph = _load(name, record=str(tmp_path / "bag"), **given)
    components = [c for c in graph.components if c.name != "camera_driver"]
    assert {c.parameters["use_sim_time"] for c in components} == {by_clock}
    (visualizer,) = [c for c in components if c.name == "surface_visualizer"]
    assert visualizer.parameters["lifetime"] == (0.0 if name == "replay" else 2.0)


@pytest.mark.parametrize(
    ("name", "given", "live"),
    [
        ("replay", {}, False),
        ("simulate", {}, True),
        ("simulate", {"record": "there"}, False),
        ("simulate", {"frame_queue": "every"}, False),
    ],
)
def test_only_what_is_live_and_not_recorded_passes_frames_over(name, given, live):
    nodes = {component.name: component.parameters for component in _load(name, **given).components}
    assert (nodes["view_splitter"]["frame_queue"] == "newest") == live


def test_a_camera_needs_a_description(tmp_path):
    with pytest.raises(InputError, match="argument sensor: found nothing, expected the file of"):
        _load("sensor")
    with pytest.raises(InputError, match="argument right_sensor: found nothing, expected the file"):
        _load("gripper", right_source="v4l2")
    with pytest.raises(
        InputError, match="right_device: found x, which has no effect with right_so"
    ):
        _load("gripper", right_device="x")


@pytest.mark.parametrize("mount", ["0 0 0", "0 0 0 0 0 up", "nan 0 0 0 0 0"])
def test_a_mount_is_six_numbers(mount):
    with pytest.raises(InputError, match=f"argument mount: found '{mount}', expected six numbers"):
        _load("replay", mount=mount)


def test_a_recording_is_not_written_over(tmp_path, grasp_bag):
    graph = _load("replay", input=str(grasp_bag), record=str(tmp_path))
    with pytest.raises(CmpTactileError, match=r"recorder .* found an existing"):
        check_recordings(graph)


def _named(settings, pattern):
    return set(re.findall(pattern, settings))


def test_rviz_shows_one_sensor_under_its_namespace_and_name():
    settings = rviz_settings(_load("replay", namespace="hand/left", name="finger"))
    assert "sample_rig" not in settings.split("Panels:")[1]
    assert _named(settings, r"Value: (/.*)/markers") == {"/hand/left"}
    assert _named(settings, r"Frame: (\w*gel_frame)") == {"finger_gel_frame"}


def test_what_is_saved_in_rviz_is_opened_again(tmp_path, monkeypatch):
    """RViz asks to save whenever a view was turned: into a file that lasts, one for the sensors.

    ros-visualization/rviz/1284 and 1106 (an option not to ask; ros2/rviz has none),
    ros-visualization/rviz/214 and 491 (saved into the file that was loaded, over what others
    need): the packaged file is never opened for writing, and the one that RViz saves is kept.
    """
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    graph = _load("replay")
    path = rviz_settings_file(graph)
    assert path.suffix == ".rviz"
    assert path.is_relative_to(tmp_path)
    assert path.read_text().count("/sample_rig/markers") == 1
    # Ours is renewed as the packaged one may have been, and what RViz saves is not.
    path.write_text("# of an earlier version\n")
    assert rviz_settings_file(graph) == path
    assert path.read_text() == rviz_settings(graph)
    saved = yaml.safe_dump(yaml.safe_load(path.read_text()))
    path.write_text(saved)
    assert rviz_settings_file(graph) == path
    assert path.read_text() == saved
    # Other sensors, or others of these names elsewhere, have files of their own.
    others = [_load("replay", name="finger"), _load("replay", namespace="hand"), _load("gripper")]
    others.append(_load("gripper", left_parent_frame="tool", right_parent_frame="tool"))
    assert len({path, *map(rviz_settings_file, others)}) == 5


def test_rviz_shows_both_fingers_in_the_frame_they_are_mounted_on():
    given = {"namespace": "hand", "left_name": "right_finger", "right_name": "other"}
    graph = _load("gripper", **given, left_parent_frame="tool", right_parent_frame="tool")
    settings = rviz_settings(graph)
    # Left and right change places where their names do.
    assert _named(settings, r"Value: (/.*)/markers") == {"/hand/right_finger", "/hand/other"}
    first = re.search(r"Name: Left finger\n", settings)
    assert first is not None
    assert "/hand/other/" not in settings[: first.start()]
    assert yaml.safe_load(settings)["Visualization Manager"]["Global Options"]["Fixed Frame"] == (
        "tool"
    )
    alone = rviz_settings(_load("gripper", left_parent_frame=""))
    assert "Fixed Frame: left_finger_gel_frame" in alone


def test_the_document_lists_the_arguments_of_the_graphs():
    assert ARGUMENTS.read_text(encoding="utf-8") == TABLE["renew"](ARGUMENTS), (
        "run: setup/run python3 docs/argument_table.py docs/launch_arguments.md"
    )


def test_every_graph_has_a_launch_file():
    files = {path.name for path in (ROOT / "cmp_tactile_bringup" / "launch").glob("*.launch.py")}
    assert files == {f"{name}.launch.py" for name in GRAPHS}


DOCUMENTS = ("README.md", "docs/*.md", "docs/tutorials/*.md", "cmp_tactile_*/README.md")


def test_the_commands_of_all_documents_can_be_given_as_they_stand():
    """No argument that is not there; a camera has a sensor."""
    count = 0
    for path in (path for pattern in DOCUMENTS for path in ROOT.glob(pattern)):
        prose = path.read_text(encoding="utf-8").partition(TABLE["MARKER"])[0].replace("\\\n", " ")
        for name, given in re.findall(
            r"ros2 launch cmp_tactile_bringup ([a-z]+)\.launch\.py(.*)", prose
        ):
            count += 1
            arguments = (*GRAPHS[name].arguments, *LAUNCH_ARGUMENTS)
            named = set(re.findall(r"(\w+):=", given))
            assert named <= {item.name for item in arguments}, path
            assert "sensor" in named or name != "sensor", path
    assert count >= 20


def test_the_parameter_file_of_the_document_fits_a_gripper(tmp_path):
    text = re.search(r"```yaml\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    assert text is not None
    file = tmp_path / "params.yaml"
    file.write_text(text[1])
    graph = load_graph("gripper")
    found = parameters_of_nodes(file, [c.full_name for c in graph.components])
    assert found["/left_finger/camera_driver"] == {"controls.exposure_time_absolute": 80}
    assert found["/right_finger/force_reconstructor"]["slip.full_ratio"] == 0.8


def test_the_graph_of_the_document_can_be_loaded(tmp_path):
    text = re.search(r"```python\n(# my_graph.py\n.*?)```", DOCUMENT.read_text("utf-8"), re.DOTALL)
    assert text is not None
    file = tmp_path / "my_graph.py"
    file.write_text(text[1])
    *_, mine, camera = load_graph(str(file), {"scene": "slip", "gain": "0.5"}).components
    assert (mine.full_name, mine.parameters) == ("/prototype/filter", {"gain": 0.5})
    assert camera.parameters["input"] == "slip"
    with pytest.raises(InputError, match=r"argument device: found x, which has no effect with so"):
        load_graph(str(file), {"device": "x"})
