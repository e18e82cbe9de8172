"""Recordings with truth: what is written is what is read, and bad ones are refused."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest

from cmp_tactile_bringup.recording import RecordingError, Truth, find_recording, write_recording
from cmp_tactile_driver.bag_reader import BagReader
from cmp_tactile_processing.errors import DescriptionError, FrameError
from cmp_tactile_processing.sensor_library import load_sensor

SHAPE = (20, 20)


@pytest.fixture
def sensor():
    return load_sensor("sample_rig")


def write_frames(folder, count, size=(768, 1024), seed=5):
    """Random frames and truths; returns them."""
    rng = np.random.default_rng(seed)
    folder.mkdir()
    images, truths = [], []
    for k in range(count):
        images.append(rng.integers(0, 256, size, dtype=np.uint8))
        truths.append(
            {
                "corners_left_px": rng.uniform(0, 1000, (*SHAPE, 2)),
                "corners_right_px": rng.uniform(0, 1000, (*SHAPE, 2)),
                "corners_m": rng.uniform(-1e-2, 1e-2, (*SHAPE, 3)),
            }
        )
        cv2.imwrite(str(folder / f"{k:03d}.png"), images[-1])
        np.savez(folder / f"{k:03d}.npz", **truths[-1])
    return images, truths


def test_frames_truth_and_stamps_come_back(tmp_path, sensor):
    images, truths = write_frames(tmp_path / "frames", 3)
    assert write_recording(tmp_path / "frames", tmp_path / "bag", sensor) == 3
    read = list(BagReader(tmp_path / "bag").frames())
    truth = Truth.load(tmp_path / "bag_truth.npz")
    assert [frame.stamp_ns for frame in read] == truth.stamp_ns.tolist()
    # 30 Hz, in whole nanoseconds.
    assert set(np.diff(truth.stamp_ns)) <= {33_333_333, 33_333_334}
    for k, frame in enumerate(read):
        np.testing.assert_array_equal(frame.image, images[k])
        assert frame.frame_id == "sample_rig_camera_optical_frame"
        # float32 in the file: 2^-24 of 1000 px and of 1 cm.
        np.testing.assert_allclose(
            truth.corners_left_px[k], truths[k]["corners_left_px"], atol=1e-4
        )
        np.testing.assert_allclose(truth.corners_m[k], truths[k]["corners_m"], atol=1e-9)


def test_the_packaged_recording_is_whole(recording):
    frames = list(BagReader(recording.bag).frames())
    assert [frame.stamp_ns for frame in frames] == recording.truth.stamp_ns.tolist()
    assert len(frames) == 60
    starts = [phase.first_frame for phase in recording.phases]
    assert starts == sorted(set(starts))
    assert starts[-1] < len(frames)
    size = sum(path.stat().st_size for path in recording.bag.iterdir())
    assert size < 25e6


def test_a_frame_of_another_size_is_named(tmp_path, sensor):
    write_frames(tmp_path / "frames", 1, size=(480, 640))
    with pytest.raises(FrameError, match=r"000\.png: found 640 x 480 px, expected 1024 x 768"):
        write_recording(tmp_path / "frames", tmp_path / "bag", sensor)


def test_an_empty_folder_and_an_existing_bag_are_refused(tmp_path, sensor):
    with pytest.raises(RecordingError, match=r"found no \*\.png"):
        write_recording(tmp_path, tmp_path / "bag", sensor)
    write_frames(tmp_path / "frames", 1)
    (tmp_path / "bag").mkdir()
    with pytest.raises(RecordingError, match="exists already"):
        write_recording(tmp_path / "frames", tmp_path / "bag", sensor)


@pytest.fixture
def copied(tmp_path, recording):
    """A copy of the packaged recording without its frames."""
    (tmp_path / "copy").mkdir()
    shutil.copy(recording.bag / "metadata.yaml", tmp_path / "copy")
    for name in ("grasp.yaml", "grasp_truth.npz"):
        target = tmp_path / name.replace("grasp", "copy")
        shutil.copy(recording.bag.with_name(name), target)
    return tmp_path / "copy"


def test_a_recording_is_found_by_its_folder(copied):
    assert find_recording(str(copied)).sensor == "sample_rig"


def test_what_is_no_recording_is_named(tmp_path):
    with pytest.raises(RecordingError, match=r"nosuch: found no metadata\.yaml"):
        find_recording("nosuch")
    with pytest.raises(RecordingError, match=r"metadata\.yaml"):
        find_recording(str(tmp_path))


def test_a_wrong_key_in_the_notes_is_named(copied):
    notes = copied.with_name("copy.yaml")
    notes.write_text(notes.read_text() + "colour: blue\n")
    with pytest.raises(DescriptionError, match="colour"):
        find_recording(str(copied))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", b"\x93NUMPY"])
def test_a_damaged_truth_is_named(copied, content):
    copied.with_name("copy_truth.npz").write_bytes(content)
    with pytest.raises(RecordingError, match=r"copy_truth\.npz"):
        find_recording(str(copied))


def test_a_truth_with_python_objects_is_not_unpickled(copied):
    path = copied.with_name("copy_truth.npz")
    with np.load(path) as arrays:
        content = dict(arrays)
    content["corners_m"] = np.array([{"run": "me"}], dtype=object)
    np.savez(path, **content)
    with pytest.raises(RecordingError, match="allow_pickle"):
        find_recording(str(copied))


def test_a_truth_that_unpacks_to_too_much_is_refused_before_it_is_unpacked(copied):
    path = copied.with_name("copy_truth.npz")
    np.savez_compressed(path, stamp_ns=np.zeros(10_000_000))
    with pytest.raises(RecordingError, match="expected at most"):
        find_recording(str(copied))


def test_a_truth_without_an_array_names_it(copied):
    path = copied.with_name("copy_truth.npz")
    with np.load(path) as arrays:
        content = {key: arrays[key] for key in arrays if key != "corners_m"}
    np.savez(path, **content)
    with pytest.raises(RecordingError, match="found no corners_m"):
        find_recording(str(copied))
