"""What `cmp_tactile process` writes: bag, tables, the same each time; which part, which zero."""

import csv
import sys
from functools import partial

import cv2
import numpy as np
import pytest
import yaml
from command_output import run
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from cmp_tactile_bringup.offline.outputs import ResultBag
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing import load
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import find_sensor_description, load_sensor

# float32 on the wire: half a unit in the last place of 1000 px, of 10 mm, of 10 N.
ATOL_PX = 1e-4
ATOL_M = 1e-9
ATOL_N = 1e-6
# Corners that are followed and the same ones found again, a fraction of their noise apart.
ATOL_STILL_M = 1e-6


process = partial(run, "process", "--sensor", "sample_rig")


def records(path):
    """(topic, type, log time, bytes) of each message."""
    with AnyReader([path]) as reader:
        return [(c.topic, c.msgtype, time, bytes(data)) for c, time, data in reader.messages()]


@pytest.fixture(scope="session")
def results(recording, tmp_path_factory):
    """The bag of two frames, one of them pressed, with what was written into it."""
    path = tmp_path_factory.mktemp("bag") / "two.mcap"
    sensor = load_sensor("sample_rig")
    pipeline = Pipeline(sensor)
    frames = list(BagReader(recording.bag).frames())
    shown = [(frame, pipeline.process(frame.image, frame.stamp_ns)) for frame in frames[:8:7]]
    with ResultBag(path, sensor, ("left", "right"), "nominal") as bag:
        for frame, result in shown:
            bag.append(frame, result)
    return path, shown


@pytest.mark.ros
def test_the_nodes_messages_are_in_the_bag_as_ros_reads_them(results):
    """Frames, stamps and numbers, with the classes of ROS, not those that wrote them."""
    from rclpy.serialization import deserialize_message

    from cmp_tactile_msgs.msg import ForceField, Grid, Surface
    from cmp_tactile_processing.ros.messages.reading import (
        force_field_from_msg,
        grid_from_msg,
        stamp_ns,
        surface_from_msg,
    )

    path, shown = results
    kinds = {"left/grid": Grid, "right/grid": Grid, "surface": Surface, "force_field": ForceField}
    found = {name: [] for name in kinds}
    for topic, _, _, data in records(path):
        name = topic.removeprefix("/sample_rig/")
        if name in kinds:
            found[name].append(deserialize_message(data, kinds[name]))
    for k, (frame, result) in enumerate(shown):
        shape = result.surface.shape
        grid = grid_from_msg(found["right/grid"][k], shape)
        np.testing.assert_allclose(grid.corners, result.right.corners, atol=ATOL_PX)
        assert found["right/grid"][k].header.frame_id == "sample_rig_right_optical_frame"
        surface = surface_from_msg(found["surface"][k], shape)
        np.testing.assert_allclose(surface.position, result.surface.position, atol=ATOL_M)
        field = force_field_from_msg(found["force_field"][k])
        np.testing.assert_allclose(field.force, result.force.force, atol=ATOL_N)
        assert len(field.contacts) == len(result.force.contacts)
        for mine, theirs in zip(field.contacts, result.force.contacts, strict=True):
            np.testing.assert_array_equal(mine.nodes, theirs.nodes)
            np.testing.assert_allclose(mine.outline, theirs.outline, atol=ATOL_M)
        header = found["force_field"][k].header
        assert header.frame_id == "sample_rig_gel_frame"
        assert stamp_ns(header.stamp) == frame.stamp_ns
    assert field.contacts


@pytest.mark.ros
def test_transforms_and_calibration_are_those_that_the_splitter_publishes(results):
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import CameraInfo
    from tf2_msgs.msg import TFMessage

    from cmp_tactile_processing.geometry.rectification import Rectification
    from cmp_tactile_processing.ros.messages.conversions import ROS_MESSAGES, camera_info_to_msg
    from cmp_tactile_processing.ros.messages.making import rectified_frame, static_transforms

    sensor = load_sensor("sample_rig")
    rectification = Rectification(sensor)
    found = {topic: data for topic, _, _, data in records(results[0])}
    message = deserialize_message(found["/tf_static"], TFMessage)
    assert list(message.transforms) == static_transforms(ROS_MESSAGES, sensor, rectification)
    info = deserialize_message(found["/sample_rig/right/camera_info"], CameraInfo)
    assert info.header.frame_id == rectified_frame(sensor, "right")
    assert info == camera_info_to_msg(rectification.info("right"), info.header)


def test_the_bag_says_what_it_was_made_with_and_plays_beside_the_recording(images, tmp_path):
    assert process(images, "--output", tmp_path, "--frame-rate", 10, "--views", "left") == 0
    found = records(tmp_path / "images.mcap")
    times = [time for topic, _, time, _ in found if topic == "/sample_rig/wrench"]
    assert times == [0, 10**8, 2 * 10**8]
    topics = {topic.removeprefix("/sample_rig/") for topic, _, _, _ in found}
    of_left = {"left/camera_info", "left/grid", "right/camera_info"}
    assert topics == of_left | {"/tf_static", "surface", "force_field", "wrench"}
    with (tmp_path / "images.mcap").open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        (metadata,) = reader.iter_metadata()
        facts = yaml.safe_load(metadata.metadata["serialized_metadata"])["custom_data"]
        assert facts["reference"] == "nominal"
        assert "cmp_tactile " in facts["software"]
        latched = {
            c.topic
            for c in reader.get_summary().channels.values()
            if "transient" in c.metadata["offered_qos_profiles"]
        }
    description = (tmp_path / "images.yaml").read_bytes()
    assert description == find_sensor_description("sample_rig").read_bytes()
    infos = {f"/sample_rig/{view}/camera_info" for view in ("left", "right")}
    assert latched == {"/tf_static"} | infos


def test_parquet_has_the_columns_of_the_csv_with_types_and_units(images, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    assert process(images, "--output", tmp_path, "--parquet") == 0
    table = parquet.read_table(tmp_path / "images_wrench.parquet")
    with (tmp_path / "images_wrench.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert table.column_names == list(rows[0])
    types = {item.name: str(item.type) for item in table.schema}
    for name in table.column_names:
        values = [row[name] for row in rows]
        if types[name] != "string":
            values = [float(value) for value in values]
        np.testing.assert_array_equal(table[name].to_numpy(zero_copy_only=False), values)
    assert types["stamp_ns"] == "int64"
    assert types["fz_N"] == "double"
    assert types["flags"] == "uint16"
    assert types["slip"] == "string"
    units = {item.name: item.metadata[b"unit"].decode() for item in table.schema}
    wanted = {"stamp_ns": "ns", "fx_N": "N", "std_mz_Nm": "N m", "contact_area_m2": "m^2"}
    assert {name: units[name] for name in wanted} == wanted
    assert units["slip_ratio"] == units["friction_std"] == "1"


def test_all_that_process_writes_is_opened_as_the_same_arrays(images, tmp_path, capsys):
    assert process(images, "--output", tmp_path, "--parquet", "--arrays") == 0
    bag = tmp_path / "images.mcap"
    assert f'cmp_tactile_processing.load("{bag}")' in capsys.readouterr().err
    whole = load(tmp_path)
    assert {"displacement", "node_force", "wrench", "usable", "stamp_fault"} <= set(whole)
    others = ("images.mcap", "images.npz", "images_wrench.csv", "images_wrench.parquet")
    for found in (load(tmp_path / name) for name in others):
        np.testing.assert_array_equal(found["stamp_ns"], whole["stamp_ns"])
        for name in set(found.data_vars) - {"stamp_fault"}:
            assert found[name].dims == whole[name].dims
            np.testing.assert_allclose(found[name], whole[name], rtol=1e-6, atol=1e-9)
    (tmp_path / "other_wrench.csv").touch()
    with pytest.raises(InputError, match="found the results of images, other, expected one"):
        load(tmp_path)


def test_parquet_without_pyarrow_is_refused_before_any_work(images, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    assert process(images, "--output", tmp_path / "out", "--parquet") == 1
    assert "error: --parquet: found no pyarrow" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def wrench_rows(folder):
    with (folder / "images_wrench.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_part_of_the_recording_begins_and_ends_where_it_is_asked_to(images, tmp_path, capsys):
    part = ("--frame-rate", 10, "--start", 0.1, "--end", 0.19)
    assert process(images, "--output", tmp_path, *part) == 0
    assert [row["stamp_ns"] for row in wrench_rows(tmp_path)] == ["100000000"]
    assert process(images, "--output", tmp_path / "none", "--start", 7) == 1
    err = capsys.readouterr().err
    assert "images: found no frame from 7 to inf s, expected times from 0 to 0.067 s" in err
    assert process(images, "--output", tmp_path / "none", "--start", 2, "--end", 1) == 2


def test_the_first_frames_as_reference_make_the_zero(images, tmp_path, capsys):
    """Against the nominal surface, noise of the reference is in every frame."""
    first = images / "0.png"
    for k in (1, 2):
        (images / f"{k}.png").write_bytes(first.read_bytes())
    assert process(images, "--output", tmp_path, "--reference", "first-2", "--arrays") == 0
    err = capsys.readouterr().err
    assert "reference 1 is the mean of 2 frames" in err
    with np.load(tmp_path / "images.npz") as arrays:
        assert np.nanmax(abs(arrays["displacement"])) < ATOL_STILL_M
    moved = cv2.imread(str(first), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(images / "1.png"), np.roll(moved, 20, axis=0))
    assert process(images, "--output", tmp_path / "two", "--reference", "first-2") == 1
    assert "expected a gel at rest" in capsys.readouterr().err


def test_the_reference_is_taken_by_itself_as_the_node_takes_it(images, tmp_path, capsys):
    """20 frames show that the gel is still; of fewer it is said that there is none."""
    first = (images / "0.png").read_bytes()
    wanted = ("--reference", "when_still")
    assert process(images, "--output", tmp_path / "few", *wanted) == 0
    err = capsys.readouterr().err
    assert ": nominal surface" in err
    assert "warning: " in err
    assert "no reference was taken: too few frames to say whether the gel is still" in err
    for k in range(21):
        (images / f"{k}.png").write_bytes(first)
    assert process(images, "--output", tmp_path, *wanted) == 0
    err = capsys.readouterr().err
    assert "relative to: reference 1 is the mean of 20 frames, taken automatically" in err
    numbers = []
    with AnyReader([tmp_path / "images.mcap"]) as reader:
        for item, _, data in reader.messages():
            if item.topic == "/sample_rig/surface":
                numbers.append(reader.deserialize(data, item.msgtype).reference_id)
    assert numbers == [0] * 19 + [1, 1]


@pytest.mark.parametrize("text", ["first-0", "first-1001", "first-x", "still"])
def test_a_reference_that_is_none_is_a_wrong_option(text, capsys):
    assert run("process", "x", "--output", "y", "--reference", text) == 2
    assert f"found '{text}', expected nominal, when_still, at_start, or first-N" in (
        capsys.readouterr().err
    )
