"""Bags give frames, stamps and camera infos as recorded; damage is reported with what is left."""

import shutil
import sqlite3
import struct
from contextlib import closing
from dataclasses import replace

import made_bags
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from cmp_tactile_driver.bags.reader import BagReader, RecordedCameraInfo, calibration_mismatch
from cmp_tactile_driver.bags.recording import open_recording
from cmp_tactile_driver.bags.timeline import TimeSpan
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.geometry.rectification import ViewCameraInfo
from cmp_tactile_processing.sensor.description import load_sensor


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("kind", ["image", "compressed"])
def test_pixels_and_stamps(tmp_path, frames, storage, kind):
    make = getattr(made_bags, kind)
    topic = "/rig/image_raw" + ("/compressed" if kind == "compressed" else "")
    messages = list(map(make, frames, made_bags.stamps(len(frames))))
    path = made_bags.write(tmp_path / "bag", {topic: messages}, storage)
    files = [path, *path.glob("*.mcap"), *path.glob("*.db3")]
    assert len(files) == 2
    for place in files:
        found = list(BagReader(place).frames())
        assert {frame.frame_id for frame in found} == {"rig_camera_optical_frame"}
        made_bags.assert_played(found, frames)


def test_wrong_paths(tmp_path):
    with pytest.raises(FrameSourceError, match=r"none.mcap: found no such file or folder"):
        BagReader(tmp_path / "none.mcap")
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0")
    with pytest.raises(
        FrameSourceError, match=r"found a .bag file, expected a folder, .mcap or .db3"
    ):
        BagReader(tmp_path / "old.bag")
    (tmp_path / "bad.mcap").write_bytes(b"nothing of the kind" * 10)
    with pytest.raises(FrameSourceError, match=r"bad.mcap: damaged, no message can be read"):
        BagReader(tmp_path / "bad.mcap")
    (tmp_path / "bad.db3").write_bytes(b"nothing of the kind" * 10)
    with pytest.raises(FrameSourceError, match=r"bad.db3: damaged, no message can be read"):
        BagReader(tmp_path / "bad.db3")


def test_topics_are_listed_where_none_fits(tmp_path, frames):
    info = made_bags.camera_info(frames[0], 0)
    path = made_bags.write(tmp_path / "bag", {"/rig/camera_info": [info]})
    with pytest.raises(
        FrameSourceError, match=r"topics: /rig/camera_info \(sensor_msgs/msg/CameraInfo\)"
    ):
        BagReader(path)


def test_choice_of_the_topic(tmp_path):
    small, large = made_bags.frames(1)[0], made_bags.frames(1, 20, 30)[0]
    image, other = made_bags.image(small, 0), made_bags.image(large, 0)
    recorded = {"/rig/image_raw": [image], "/rig/left/image_raw": [other]}
    path = made_bags.write(tmp_path / "sensor", recorded)
    assert BagReader(path).image_topic == "/rig/image_raw"
    assert BagReader(path, "/rig/left/image_raw").image_topic == "/rig/left/image_raw"
    with pytest.raises(FrameSourceError, match="found no images on '/none'"):
        BagReader(path, "/none")
    two = made_bags.write(tmp_path / "two", {"/a/image_raw": [image], "/b/image_raw": [image]})
    with pytest.raises(FrameSourceError, match=r"several image topics, .*: /a/image_raw, /b"):
        BagReader(two)
    assert BagReader(two, namespace="b").image_topic == "/b/image_raw"
    assert BagReader(path, namespace="other").image_topic == "/rig/image_raw"


@pytest.mark.parametrize(
    ("kept", "topic"),
    [(0, ""), (0, "/rig/image_raw"), (2, ""), (2, "rig/image_raw/compressed")],
)
def test_of_two_transports_the_fuller_one_is_read(tmp_path, frames, kept, topic):
    """Tried: "the topic is empty", or two frames of twelve and no word."""
    rows = []
    for frame, stamp in zip(frames, made_bags.stamps(len(frames)), strict=True):
        rows.append(("/rig/image_raw", stamp, made_bags.image(frame, stamp)))
        rows.append(("/rig/image_raw/compressed", stamp, made_bags.compressed(frame, stamp)))
    path = made_bags.write_rows(tmp_path / "bag", rows, StoragePlugin.SQLITE3)
    with closing(sqlite3.connect(path / "bag.db3")) as bag:
        # The raw topic is the first.
        first_lost = (made_bags.stamps(kept + 1)[-1],)
        bag.execute("DELETE FROM messages WHERE topic_id = 1 AND timestamp >= ?", first_lost)
        bag.commit()
    made_bags.assert_played(BagReader(path / "bag.db3", topic).frames(), frames)


def test_bad_messages_are_skipped_and_named(tmp_path, frames):
    times = made_bags.stamps(len(frames))
    messages = made_bags.images(frames)
    messages[3] = made_bags.image(frames[3], times[3], encoding="32FC1")
    messages[5] = made_bags.image(frames[5][:, :32], times[5])
    messages[7] = made_bags.image(frames[7], times[7], data=frames[7].ravel()[:-1])
    reader = BagReader(made_bags.write(tmp_path / "bag", {"/image_raw": messages}))
    found = []
    problems = set()
    for frame in reader.frames():
        found.append(frame.stamp_ns)
        problems.add(reader.health.problem)
    assert found == [time for number, time in enumerate(times) if number not in (3, 5, 7)]
    assert reader.health.bad_frames == 3
    text = " ".join(problems)
    assert f"/image_raw at {times[3]} ns: encoding: found '32FC1'" in text
    assert f"/image_raw at {times[5]} ns: found 32 x 48 px, expected 64 x 48 px" in text
    assert f"/image_raw at {times[7]} ns: data: found 3071 bytes, expected 3072" in text


@pytest.mark.parametrize("kind", ["bag", "folder", "image"])
def test_a_recording_without_a_good_frame_names_its_path_once(tmp_path, frames, kind):
    """Tried: the path stood up to three times in the line."""
    path = tmp_path / "recording"
    if kind == "bag":
        bad = [replace(item, encoding="32FC1") for item in made_bags.images(frames)]
        made_bags.write(path, {"/rig/image_raw": bad})
    else:
        path.mkdir()
        (path / "0.png").write_bytes(b"no image")
        path = path / "0.png" if kind == "image" else path
    with pytest.raises(FrameSourceError) as raised:
        list(open_recording(path).frames())
    assert str(raised.value).count(str(path)) == 1


def test_two_frames_of_another_size_at_the_beginning_end_the_reading(tmp_path, frames):
    """One is skipped where the next is right."""
    messages = made_bags.images(frames)
    messages[0] = made_bags.image(frames[0][:, :32], made_bags.FIRST_STAMP_NS)
    bag = made_bags.write(tmp_path / "bag", {"/image_raw": messages})
    assert len(list(BagReader(bag, expected_size=(64, 48)).frames())) == len(frames) - 1
    other = BagReader(bag, expected_size=(1024, 768))
    with pytest.raises(
        FrameSourceError, match=r"no frame can be used.*found 64 x 48 px, expected 1024"
    ):
        next(other.frames())
    assert other.health.bad_frames == 2


def test_a_stamp_that_ros_does_not_know_is_that_of_a_bad_frame(tmp_path, frames):
    """Nobody could publish it, nor write it into another bag."""
    messages = [made_bags.image(frame, number) for number, frame in enumerate(frames)]
    messages[2] = made_bags.image(frames[2], -(10**9))
    reader = BagReader(made_bags.write(tmp_path / "bag", {"/image_raw": messages}))
    assert len(list(reader.frames())) == len(frames) - 1
    assert "header.stamp: found -1 s, expected 0 or more" in reader.health.problem


def test_camera_infos_that_cannot_be_read_are_left_out_and_named(frame_bag, frames, monkeypatch):
    """Whoever publishes their bytes would fail by them."""
    reader = BagReader(frame_bag)
    assert reader.has_camera_info
    stored = reader._storage.read

    def cut(*args):
        for number, item in enumerate(stored(*args)):
            is_first_info = number < 2 and item.topic == "/rig/camera_info"
            yield replace(item, data=item.data[:40]) if is_first_info else item

    monkeypatch.setattr(reader._storage, "read", cut)
    found = list(reader.messages())
    infos = [item for item in found if isinstance(item, RecordedCameraInfo)]
    assert (len(infos), len(found)) == (len(frames) - 1, 2 * len(frames) - 1)
    assert "/rig/camera_info at" in reader.health.problem
    assert "not a sensor_msgs/msg/CameraInfo" in reader.health.problem
    assert reader.health.bad_frames == 0


@pytest.fixture
def large_bag(tmp_path):
    """Forty frames of 300 kB: several chunks."""
    frames = made_bags.frames(40, 480, 640)
    return made_bags.write(tmp_path / "bag", {"/image_raw": made_bags.images(frames)}), frames


@pytest.mark.parametrize("with_metadata", [True, False])
@pytest.mark.parametrize("fraction", [0.3, 0.77, 0.999])
def test_truncated_mcap_gives_what_is_left(large_bag, fraction, with_metadata):
    path, frames = large_bag
    file = next(path.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * fraction)])
    if not with_metadata:
        (path / "metadata.yaml").unlink()
    reader = BagReader(path)
    found = list(reader.frames())
    # Only the chunk that is cut is lost, which holds four frames.
    assert len(found) >= int(fraction * len(frames)) - 4
    made_bags.assert_played(found, frames[: len(found)])
    left = f"{len(found)} of 40 messages can be read"
    if not with_metadata:
        left = f"{len(found)} messages can be read"
    assert left in reader.health.problem


@pytest.mark.parametrize("suffix", ["mcap", "db3"])
def test_an_empty_file_is_said_to_be_empty(tmp_path, suffix):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / f"bag_0.{suffix}").write_bytes(b"")
    with pytest.raises(FrameSourceError, match=rf"bag_0.{suffix}: .*the file is empty"):
        BagReader(tmp_path / "bag")


def test_only_the_damaged_chunk_is_lost(large_bag):
    path, frames = large_bag
    file = next(path.glob("*.mcap"))
    content = bytearray(file.read_bytes())
    # The record of a message in the middle says that it is absurdly long.
    message = made_bags.image(frames[0], 0)
    size = len(made_bags.STORE.serialize_cdr(message, message.__msgtype__))
    record = b"\x05" + struct.pack("<Q", 22 + size)
    at = content.index(record, len(content) // 2)
    content[at : at + 9] = b"\x05" + b"\xff" * 8
    file.write_bytes(content)
    reader = BagReader(path)
    count = sum(1 for _ in reader.frames())
    # A chunk holds four frames.
    assert len(frames) - 4 <= count < len(frames)
    assert f"{count} of {len(frames)} messages can be read" in reader.health.problem


def test_truncated_sqlite_is_reported(tmp_path):
    messages = made_bags.images(made_bags.frames(40, 480, 640))
    path = made_bags.write(tmp_path / "bag", {"/image_raw": messages}, StoragePlugin.SQLITE3)
    file = next(path.glob("*.db3"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(FrameSourceError, match=r"bag.db3: damaged, .*malformed"):
        BagReader(path)


def test_a_video_is_played_at_its_own_rate_and_in_part(tmp_path):
    """What `process` takes, replay takes too."""
    shown = [np.full((48, 64, 3), 40 * number, np.uint8) for number in range(6)]
    path = made_bags.write_video(tmp_path / "film.mp4", "mp4v", shown)
    options = {"topic": "", "frame_rate": 7.0, "frame_id": "cam"}
    film = open_recording(path, **options)
    stamps = [message.stamp_ns for message in film.messages()]
    assert stamps == [40_000_000 * number for number in range(6)]
    assert film.duration == pytest.approx(0.2)
    part = list(film.messages(TimeSpan(0.08, 0.16)))
    assert [message.stamp_ns for message in part] == [80_000_000, 120_000_000]
    # Compression loses a few grey levels.
    assert [message.image.mean() for message in part] == pytest.approx([80, 120], abs=5)
    assert {message.frame_id for message in part} == {"cam"}


def test_a_folder_without_bag_is_a_folder_of_images(image_folder, frames, tmp_path):
    options = {"topic": "", "frame_rate": 20.0, "frame_id": "cam"}
    found = list(open_recording(image_folder, **options).messages())
    assert [message.stamp_ns for message in found] == [n * 50_000_000 for n in range(len(frames))]
    (image_folder / "results.mcap").mkdir()
    (image_folder / "4.png").write_bytes(b"")
    found = list(open_recording(image_folder, **options).messages())
    assert [message.stamp_ns // 50_000_000 for message in found] == [
        *range(4),
        *range(5, len(frames)),
    ]
    shutil.rmtree(image_folder)
    with pytest.raises(FrameSourceError, match="found no such file or folder"):
        open_recording(image_folder, **options)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FrameSourceError, match="found nothing, expected the files of a bag"):
        open_recording(tmp_path / "empty", **options)


SENSOR = load_sensor("sample_rig")
K = np.array([[733.386, 0, 511.5], [0, 733.386, 383.5], [0, 0, 1]])
TOPIC = "/rig/camera_info"
OWN = ViewCameraInfo(1024, 768, "plumb_bob", np.zeros(5), K, np.eye(3), np.eye(3, 4))


@pytest.mark.parametrize(
    "found",
    [
        OWN,
        replace(OWN, D=np.zeros(0)),
        replace(OWN, D=np.zeros(8)),
        replace(OWN, model="rational_polynomial", D=np.zeros(14)),
        replace(OWN, K=np.zeros((3, 3)), D=np.ones(5)),
        replace(OWN, width=0, height=0, K=np.zeros((3, 3)), D=np.zeros(0)),
    ],
    ids=["rounded", "D left out", "D of another length", "rational", "not calibrated", "unset"],
)
def test_what_does_not_contradict_the_description_is_taken(found):
    """Reports: ros-drivers/usb_cam 26, ros-drivers/gscam 103 (0 x 0), luxonis/depthai-ros 598
    (K = 0 with a size); tried: no doubt.
    """
    assert calibration_mismatch(TOPIC, found, SENSOR) == ""


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"width": 640}, "/rig/camera_info: width: found 640, expected 1024: is sample_rig the"),
        ({"height": 480}, "/rig/camera_info: height: found 480, expected 768"),
        (
            {"K": K * [[0.9, 1, 1], [1, 1, 1], [1, 1, 1]]},
            "K: found [660.047, 0, 511.5, 0, 733.386, 383.5, 0, 0, 1], expected [733.386, 0,",
        ),
        ({"D": np.array([0.0, 0.0, 0.2])}, "D: found [0, 0, 0.2], expected [0, 0, 0, 0, 0]"),
        ({"model": "equidistant"}, "distortion_model: found equidistant, expected plumb_bob"),
    ],
)
def test_a_difference_names_topic_field_found_and_expected(change, expected):
    assert expected in calibration_mismatch(TOPIC, replace(OWN, **change), SENSOR)


CHIP = {"width": 2448, "height": 2048}
K_OF_CHIP = np.array([2 * 733.386, 0, 1123.5, 0, 2 * 733.386, 817.5, 0, 0, 1])


@pytest.mark.parametrize(
    "fields",
    [{**CHIP, "k": K_OF_CHIP}, {**CHIP, "k": K.ravel()}, {"k": K.ravel()}],
    ids=["as ROS wants it", "K of the image", "all of the image"],
)
def test_a_camera_info_of_a_binned_window_is_that_of_its_image(tmp_path, fields):
    """Reports: astuff/avt_vimba_camera 82, basler/pylon-ros-camera 143,
    ros-perception/image_pipeline 119; tried: each was taken for another camera.
    """
    window = made_bags.STORE.types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=100, y_offset=50, height=1536, width=2048, do_rectify=False
    )
    frame = np.zeros((768, 1024), np.uint8)
    info = made_bags.camera_info(frame, made_bags.FIRST_STAMP_NS)
    info = replace(info, **fields, d=np.zeros(5), roi=window)
    topics = {TOPIC: [info], "/rig/image_raw": made_bags.images([frame])}
    assert BagReader(made_bags.write(tmp_path / "a", topics)).calibration_mismatch(SENSOR) == ""
    topics[TOPIC] = [replace(info, k=info.k + 2)]
    bag = BagReader(made_bags.write(tmp_path / "b", topics))
    assert "/rig/camera_info: " in bag.calibration_mismatch(SENSOR)


def test_a_sensor_with_a_camera_per_view_is_compared_by_size():
    several = replace(SENSOR, camera=None)
    assert calibration_mismatch(TOPIC, replace(OWN, K=2 * K), several) == ""
    assert "width" in calibration_mismatch(TOPIC, replace(OWN, width=1), several)


def _twelve_bits(frames):
    """The frames with 12 of 16 bits; of the first three no pixel is above 900."""
    deep = [frame.astype(np.uint16) * 16 for frame in frames]
    return [(frame // 5 if number < 3 else frame) for number, frame in enumerate(deep)]


def test_12_bits_have_one_scale_from_a_dark_beginning_to_the_end(tmp_path, frames, caplog):
    deep = _twelve_bits(frames)
    messages = [
        made_bags.image(
            frame.astype("<u2"), number, encoding="mono16", data=frame.view(np.uint8).ravel()
        )
        for number, frame in enumerate(deep)
    ]
    reader = BagReader(made_bags.write(tmp_path / "bag", {"/image_raw": messages}))
    for _ in range(2):
        found = list(reader.frames())
        assert len(found) == len(frames)
        for frame, expected in zip(found, deep, strict=True):
            assert np.abs(frame.image - expected * (255 / 4095)).max() <= 0.51
    assert caplog.text.count("12 of 16 bits") == 1
    assert reader.health.bad_frames == 0


def test_a_mosaic_in_a_bag(tmp_path, frames):
    """ros-perception/image_pipeline's debayer is not needed."""
    messages = [made_bags.image(frame, 0, encoding="bayer_rggb8") for frame in frames]
    reader = BagReader(made_bags.write(tmp_path / "bag", {"/image_raw": messages}))
    assert {frame.image.shape for frame in reader.frames()} == {(48, 64, 3)}
