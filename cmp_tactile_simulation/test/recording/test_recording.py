"""What is written of a scene is what was simulated, for the suite's readers and for others."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import Reader

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.recording.run import RunOptions, recording_of, run_scene
from cmp_tactile_simulation.recording.truth import read_truth, recorded_frames
from cmp_tactile_simulation.scenes.file import read_scene
from cmp_tactile_simulation.scenes.simulation import Simulation

# Messages hold float32: half a unit in the last place of 256 px, 10 mm and 1 N.
ATOL_PX, ATOL_M, ATOL_N = 2e-5, 1e-9, 1e-7
FRAMES = 4


@pytest.fixture(scope="module")
def scene(small_scene):
    return small_scene()


@pytest.fixture(scope="module")
def frames(scene):
    return list(Simulation(scene).frames())[:FRAMES]


@pytest.fixture(scope="module")
def bag(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bag") / "press"
    run_scene(scene, folder, RunOptions(frames=FRAMES, video=True))
    return folder


@pytest.fixture(scope="module")
def images(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("png") / "press"
    run_scene(scene, folder, RunOptions(format="png", frames=FRAMES))
    return folder


def test_the_bag_holds_the_frames_without_loss(bag, frames):
    reader = BagReader(bag)
    read = list(reader.frames())
    assert reader.image_topic == "/small/image_raw/compressed"
    assert (len(read), reader.health.problem) == (FRAMES, "")
    for found, frame in zip(read, frames, strict=True):
        assert (found.stamp_ns, found.frame_id) == (frame.stamp_ns, "small_camera_optical_frame")
        np.testing.assert_array_equal(found.image, frame.image)


def test_the_bag_is_one_of_rosbag2(bag):
    information = yaml.safe_load((bag / "metadata.yaml").read_text())
    information = information["rosbag2_bagfile_information"]
    assert information["storage_identifier"] == "mcap"
    assert information["relative_file_paths"] == ["press.mcap"]
    with Reader(bag) as reader:
        kinds = {item.topic: item.msgtype for item in reader.connections}
        counts = {item.topic: item.msgcount for item in reader.connections}
        stamps = [stamp for _, stamp, _ in reader.messages()]
    assert kinds == {
        "/small/camera_info": "sensor_msgs/msg/CameraInfo",
        "/small/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
        "/small/truth/surface": "cmp_tactile_msgs/msg/Surface",
        "/small/truth/force_field": "cmp_tactile_msgs/msg/ForceField",
        "/small/truth/left/grid": "cmp_tactile_msgs/msg/Grid",
        "/small/truth/right/grid": "cmp_tactile_msgs/msg/Grid",
        "/small/truth/indenter_pose": "geometry_msgs/msg/PoseStamped",
    }
    assert set(counts.values()) == {FRAMES}
    assert stamps == sorted(stamps)


def test_the_truth_is_read_back(bag, frames):
    truth = read_truth(bag)
    assert truth.stamp_ns.tolist() == [frame.stamp_ns for frame in frames]
    for k, frame in enumerate(frames):
        left, right = frame.grids["left"], frame.grids["right"]
        np.testing.assert_allclose(truth.corners_left_px[k], left.corners_frame, atol=ATOL_PX)
        np.testing.assert_allclose(truth.corners_right_px[k], right.corners_frame, atol=ATOL_PX)
        np.testing.assert_allclose(truth.corners_m[k], frame.surface.position, atol=ATOL_M)
        np.testing.assert_allclose(truth.wrench[k], frame.force.wrench, atol=ATOL_N)
        assert truth.contact_area[k] == pytest.approx(frame.force.contact_area)
        assert truth.slip_state[k] == frame.force.slip_state
    assert truth.wrench[-1, 2] < 0


def test_the_force_field_of_one_frame_is_read_back(bag, scene, frames):
    field = list(recorded_frames(bag, scene.sensor, ("truth/force_field",)))[3].force
    np.testing.assert_allclose(field.force, frames[3].force.force, atol=ATOL_N)
    np.testing.assert_array_equal(field.contact, frames[3].force.contact)
    assert np.isfinite([field.slip.slip_ratio, field.slip.traction_ratio]).all()
    for figure in ("state", "slip_ratio", "traction_ratio", "friction_coefficient"):
        true = getattr(frames[3].force.slip, figure)
        assert getattr(field.slip, figure) == pytest.approx(true, rel=1e-6, nan_ok=True)


def test_scene_and_sensor_are_beside_the_frames(bag, images, scene):
    for folder in (bag, images):
        again = read_scene(folder / "scene.yaml")
        assert (again.name, again.motion, again.seed) == (scene.name, scene.motion, scene.seed)
        assert SensorDescription.load(folder / "sensor.yaml").pattern == scene.sensor.pattern


def test_images_come_with_the_arrays_of_their_truth(images, frames):
    assert len(list(images.glob("*.png"))) == FRAMES
    for frame in frames:
        path = images / f"{frame.index:03d}.png"
        np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), frame.image)
        with np.load(path.with_suffix(".npz"), allow_pickle=False) as arrays:
            left = frame.grids["left"]
            expected = {
                "corners_left_px": (left.corners_frame, ATOL_PX),
                "corners_m": (frame.surface.position, ATOL_M),
                "force": (frame.force.force, ATOL_N),
                "wrench": (frame.force.wrench, ATOL_N),
                "indenter_position": (frame.pose.position, 0),
                "indenter_rotation": (frame.pose.rotation, 1e-15),
            }
            for name, (true, atol) in expected.items():
                np.testing.assert_allclose(arrays[name], true, rtol=0, atol=atol)
            # 5 x 6 corners with 2 points between: every third point of a line is a corner.
            assert arrays["row_lines_right_px"].shape == (5, 16, 2)
            assert arrays["col_lines_m"].shape == (6, 13, 3)
            rows, cols = arrays["row_lines_left_px"], arrays["col_lines_left_px"]
            np.testing.assert_array_equal(rows[:, ::3], arrays["corners_left_px"])
            np.testing.assert_array_equal(cols[:, ::3].swapaxes(0, 1), rows[:, ::3])
            between = [rows[2, 4], cols[4, 5]]
            true = [left.row_lines_frame[2, 1, 0], left.col_lines_frame[1, 4, 1]]
            np.testing.assert_allclose(between, true, atol=ATOL_PX)


def test_the_video_shows_every_frame_with_its_truth(bag):
    video = cv2.VideoCapture(str(bag / "video.mp4"))
    pictures = []
    while (read := video.read())[0]:
        pictures.append(read[1].astype(float))
    assert len(pictures) == FRAMES
    assert pictures[0].shape == (768, 1024 + 528, 3)
    panel = slice(1024, None)
    # The depth map and the wrench change as the indenter presses; codecs alone change less.
    assert np.abs(pictures[-1][:, panel] - pictures[0][:, panel]).mean() > 1


def test_the_sensor_of_one_view_has_truth_for_that_view(small_scene, tmp_path):
    left = small_scene().sensor_mapping["views"]["left"]
    mapping = dict(small_scene().sensor_mapping)
    mapping |= {"views": {"left": left}, "optics": mapping["optics"] | {"type": "monocular"}}
    (tmp_path / "one.yaml").write_text(yaml.safe_dump(mapping))
    scene = small_scene(sensor=str(tmp_path / "one.yaml"))
    run_scene(scene, tmp_path / "one", RunOptions(frames=1))
    truth = read_truth(tmp_path / "one")
    assert np.isfinite(truth.corners_left_px).any()
    assert np.isnan(truth.corners_right_px).all()


def test_a_packaged_recording_is_simulated_once(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("cmp_tactile_simulation.recording.run.load_scene", lambda _name: scene)
    reported = []
    folder = recording_of("small", lambda what, share: reported.append((what, share)), tmp_path)
    assert folder.name == "small"
    assert reported[-1] == ("simulating", 1.0)
    assert len(read_truth(folder).stamp_ns) == scene.frame_count
    reported.clear()
    assert (
        recording_of("small", lambda what, share: reported.append((what, share)), tmp_path)
        == folder
    )
    assert reported == []
    assert [path.name for path in folder.parent.iterdir()] == ["small"]


def test_a_recording_made_with_other_sources_is_another(scene, tmp_path, monkeypatch):
    module = "cmp_tactile_simulation.recording.run"
    monkeypatch.setattr(f"{module}.load_scene", lambda _name: scene)
    folder = recording_of("small", cache_dir=tmp_path)
    monkeypatch.setattr(f"{module}.simulator_version", lambda: "another")
    assert recording_of("small", cache_dir=tmp_path) != folder
