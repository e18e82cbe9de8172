"""Bags as other programs write them are read whole, in order of their stamps, and nothing is said.

Public reports, tried on this reader (report: trial: result):
- ros2/rosbag2 2058, ros2/rosbag2_storage_mcap 61: no index, receipts out of order: whole, in order
- foxglove/mcap 683: the header's profile is empty: read
- ros2/rosbag2 1276: some receipts at time 0: times by stamps, one line
- ros2/rosbag2 1572: /tf_static was received before the frames: time 0 is the first frame
- ros2/rosbag2 395, 901: SQLite without metadata.yaml: whole; what its log holds is named
- ros2/rosbag2 990: files compressed as a whole, no metadata.yaml: whole
- ros2/rosbag2 1623: messages compressed one by one in a .db3 file: read
- ros2/rosbag2 1089: SQLite of Eloquent, whose topics have no QoS: read
- ros2/rosbag2 2040: chunks without a message index: read
- ros2/rosbag2 2173: messages received at one moment: in the order in which they were written
- facontidavide/cloudini 29: other QoS in metadata.yaml than in the file: read
- foxglove/mcap 389: zstd without the content's size, of chunks or messages: read
- foxglove/mcap 1474: cut within the summary: whole, as nothing of the messages is missing
- foxglove/mcap 385: cut within a chunk: read up to that chunk (test_bag_reader)
- ouster-lidar/ouster-sdk 666: a file of a split recording without messages of the topic: counted
"""

import re
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import made_bags
import numpy as np
import pytest
import yaml
import zstandard
from made_bags import STORE
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from cmp_tactile_driver.bags.files import StoredMessage
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_driver.bags.recording import open_recording
from cmp_tactile_driver.bags.storage import BagStorage, bag_files
from cmp_tactile_driver.bags.timeline import DEFAULT_FRAME_RATE, TimeSpan, timeline
from cmp_tactile_processing.errors import FrameSourceError

IMAGE, TOPIC = "sensor_msgs/msg/Image", "/rig/image_raw"
MS = 1_000_000
HOUR_NS = 3600 * 10**9


def write_mcap(path: Path, rows: Sequence[tuple[int, Any]], **options: Any) -> Path:
    """An MCAP file of images: (receipt ns, message), in this order.

    options: profile, definition, and those of mcap's writer.
    """
    profile, definition = options.pop("profile", "ros2"), options.pop("definition", b"")
    chunking = {"compression": CompressionType.NONE, "chunk_size": 10_000, **options}
    with path.open("wb") as file:
        writer = Writer(file, **chunking)
        writer.start(profile, "other")
        schema = writer.register_schema(IMAGE, "ros2msg", definition)
        channels = [writer.register_channel(TOPIC, "cdr", schema) for _ in range(2)]
        for number, (received_ns, message) in enumerate(rows):
            data = bytes(STORE.serialize_cdr(message, IMAGE))
            # As a merge of two recordings has it, the topic has two channels.
            writer.add_message(channels[number % 2], received_ns, data, received_ns)
        writer.finish()
    return path


UNINDEXED = {"use_chunking": False, "index_types": IndexType.NONE}


def _rows(frames: Sequence[Any]) -> list[tuple[int, Any]]:
    times = made_bags.stamps(len(frames))
    return [(t + MS, made_bags.image(f, t)) for f, t in zip(frames, times, strict=True)]


def _check_whole(reader: BagReader, frames: Sequence[Any]) -> None:
    found = list(reader.frames())
    made_bags.assert_played(found, frames)
    times = [0.05 * number for number in range(len(frames))]
    assert [frame.time_s for frame in found] == pytest.approx(times)
    assert reader.duration == pytest.approx(times[-1])
    assert reader.health.problem == ""


@pytest.mark.parametrize(
    "options",
    [
        {},
        UNINDEXED,
        {"compression": CompressionType.ZSTD, "index_types": IndexType.NONE},
        {"compression": CompressionType.LZ4, "use_statistics": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {**UNINDEXED, "use_statistics": False, "use_summary_offsets": False},
        {"profile": ""},
        {"profile": "px4", "definition": b"not a definition"},
    ],
    ids=str,
)
@pytest.mark.parametrize("late_ms", [2, 700])
def test_whatever_the_writer_chose(tmp_path, frames, options, late_ms):
    rows = _rows(frames)
    for number in (3, 4, 8):
        rows[number] = rows[number][0] + late_ms * MS, rows[number][1]
    rows[1], rows[2] = rows[2], rows[1]
    reader = BagReader(write_mcap(tmp_path / "bag.mcap", rows, **options))
    _check_whole(reader, frames)
    assert reader.gaps == ""


def _without_content_size(data: bytes) -> bytes:
    packing = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    return packing.compress(data) + packing.flush()


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_zstd_that_does_not_state_the_size_of_its_content(tmp_path, frames, compression):
    """Messages that were compressed one by one, in chunks that may be compressed as well."""
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start("ros2", "other")
        channel = writer.register_channel(
            TOPIC, "cdr", writer.register_schema(IMAGE, "ros2msg", b"")
        )
        for time_ns, message in _rows(frames):
            data = _without_content_size(bytes(STORE.serialize_cdr(message, IMAGE)))
            writer.add_message(channel, time_ns, data, time_ns)
        writer.finish()
    _check_whole(BagReader(path), frames)


def test_a_message_that_cannot_be_unpacked_hides_no_other_of_its_chunk(tmp_path, frames):
    path = tmp_path / "bag.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2", "other")
        schema = writer.register_schema(IMAGE, "ros2msg", b"")
        channel = writer.register_channel(TOPIC, "cdr", schema)
        for number, (time_ns, message) in enumerate(_rows(frames)):
            data = _without_content_size(bytes(STORE.serialize_cdr(message, IMAGE)))
            writer.add_message(channel, time_ns, data[:-9] if number == 2 else data, time_ns)
        writer.finish()
    reader = BagReader(path)
    found = [frame.stamp_ns for frame in reader.frames()]
    times = made_bags.stamps(len(frames))
    assert found == [*times[:2], *times[3:]]
    assert f"{len(frames) - 1} messages can be read" in reader.health.problem


def test_a_summary_that_is_cut_loses_nothing(tmp_path, frames):
    path = write_mcap(tmp_path / "bag.mcap", _rows(frames))
    path.write_bytes(path.read_bytes()[:-150])
    _check_whole(BagReader(path), frames)


def test_a_file_of_a_split_recording_may_have_no_message_of_the_topic(tmp_path, frames):
    bag = tmp_path / "bag"
    bag.mkdir()
    rows = _rows(frames)
    write_mcap(bag / "bag_0.mcap", rows)
    write_mcap(bag / "bag_1.mcap", [])
    _check_whole(BagReader(bag), frames)


def _change_metadata(bag: Path, change: Any) -> None:
    path = bag / "metadata.yaml"
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    change(content["rosbag2_bagfile_information"])
    path.write_text(yaml.safe_dump(content), encoding="utf-8")


def _other_qos(information: Any) -> None:
    information["topics_with_message_count"][0]["topic_metadata"]["offered_qos_profiles"] = [
        {"history": 1, "depth": 3, "reliability": 2, "durability": 2}
    ]


def _other_counts(information: Any) -> None:
    information["topics_with_message_count"][0]["message_count"] = 3
    information["message_count"] = 3
    information["duration"]["nanoseconds"] = 0


def _other_names(information: Any) -> None:
    information["relative_file_paths"] = ["before_it_was_renamed_0.mcap"]


@pytest.mark.parametrize("change", [_other_qos, _other_counts, _other_names, None, "broken"])
def test_metadata_that_differs_from_the_files(tmp_path, frames, change):
    bag = made_bags.write(tmp_path / "bag", {TOPIC: made_bags.images(frames)})
    if change is None:
        (bag / "metadata.yaml").unlink()
    elif change == "broken":
        (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: [", encoding="utf-8")
    else:
        _change_metadata(bag, change)
    # macOS leaves such beside every file on a foreign disk.
    (bag / "._bag.mcap").write_bytes(b"\0\5\x16\7")
    _check_whole(BagReader(bag), frames)


def test_a_count_that_does_not_fit_is_named_in_words_of_its_own(tmp_path, frames):
    topics = {TOPIC: made_bags.images(frames)}
    bag = made_bags.write(tmp_path / "bag", topics, StoragePlugin.SQLITE3)
    with sqlite3.connect(bag / "bag.db3") as connection:
        connection.execute("DELETE FROM messages WHERE id > 10")
    reader = BagReader(bag)
    assert len(list(reader.frames())) == 10
    assert f"{TOPIC}: found 10 messages, expected 12" in reader.health.problem
    assert "damaged" not in reader.health.problem


def test_a_missing_file_of_a_split_recording_is_named(tmp_path, frames):
    bag = tmp_path / "bag"
    bag.mkdir()
    rows = _rows(frames)
    for number in range(3):
        write_mcap(bag / f"bag_{number}.mcap", rows[4 * number : 4 * number + 4])
    _check_whole(BagReader(bag), frames)
    names = [f"bag_{number}.mcap" for number in range(3)]
    text = {"relative_file_paths": names, "topics_with_message_count": []}
    content = yaml.safe_dump({"rosbag2_bagfile_information": text})
    (bag / "metadata.yaml").write_text(content, encoding="utf-8")
    (bag / "bag_1.mcap").unlink()
    reader = BagReader(bag)
    assert len(list(reader.frames())) == 8
    assert "found no file bag_1.mcap, which metadata.yaml lists" in reader.health.problem


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_zstd_of_files_and_of_messages(tmp_path, frames, mode, storage):
    bag = tmp_path / "bag"
    writer = RosbagsWriter(bag, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(TOPIC, IMAGE, typestore=STORE)
        for received_ns, message in _rows(frames):
            writer.write(connection, received_ns, STORE.serialize_cdr(message, IMAGE))
    _check_whole(BagReader(bag), frames)
    (bag / "metadata.yaml").unlink()
    _check_whole(BagReader(bag), frames)
    # One file by itself, as it is copied; a disk of Windows may have made its name upper case.
    file = next(iter(bag_files(bag)))
    _check_whole(open_recording(file), frames)
    if mode is CompressionMode.MESSAGE:
        _check_whole(open_recording(file.rename(bag / file.name.upper())), frames)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "a run.bag",
            "a bag of ROS 1, expected one of ROS 2.*--src '.*a run.bag' --dst NEW_FOLDER",
        ),
        ("frames.zip", r"6 bytes, expected a video, or a file named \.mcap, .*\.png"),
    ],
)
def test_what_is_no_recording_is_distinguished_from_a_broken_video(tmp_path, name, expected):
    """Reports: MIT-SPARK/Kimera-Multi-Data 15, ros2/rosbag2 139, rsasaki0109/littleslam_ros2 4.

    Tried: "found 6 bytes, expected a video" of each, and of a bag that was compressed as a file.
    """
    path = tmp_path / name
    path.write_bytes(b"#ROSBA")
    with pytest.raises(FrameSourceError, match=f"{name}: found {expected}"):
        open_recording(path)


LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a21\nsize 12345\n"
HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("bag/run_0.mcap", LFS_POINTER, r"run_0.mcap: found a pointer of git-lfs.* git lfs pull"),
        ("bag/run_0.db3", LFS_POINTER, r"run_0.db3: found a pointer of git-lfs.* git lfs pull"),
        ("images/0.png", LFS_POINTER, r"0.png: found a pointer of git-lfs.* git lfs pull"),
        ("press.mp4", LFS_POINTER, r"press.mp4: found a pointer of git-lfs.* git lfs pull"),
        ("images/IMG 1.HEIC", HEIC, r"heif-convert '.*/IMG 1.HEIC' '.*/IMG 1.png'"),
        ("photo.heic", HEIC, r"found a HEIC image.* heif-convert .*/photo.png"),
        ("photo.jpg", HEIC, r"found a HEIC image"),
    ],
)
def test_what_stands_for_a_recording_is_named_with_the_command_that_helps(
    tmp_path, name, content, expected
):
    """Reports: foxglove/mcap 1674, git-lfs/git-lfs 4240, opencv/opencv 22359, easymodo/qimgv 596;
    tried: "damaged", "not a readable image", "expected a video".
    """
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    recording = path if path.parent == tmp_path else path.parent
    with pytest.raises(FrameSourceError, match=expected):
        list(open_recording(recording).frames())


def test_a_device_is_no_recording():
    with pytest.raises(FrameSourceError, match="/dev/null: found no such file or folder"):
        open_recording(Path("/dev/null"))


def test_a_write_ahead_log_of_sqlite_is_named(tmp_path, frames):
    """A recorder that was killed leaves its last messages there."""
    times = made_bags.stamps(len(frames))
    messages = made_bags.images(frames)
    first = made_bags.write(tmp_path / "first", {TOPIC: messages[:6]}, StoragePlugin.SQLITE3)
    file = first / "first.db3"
    connection = sqlite3.connect(file)
    connection.execute("PRAGMA journal_mode=WAL")
    for time_ns, message in zip(times[6:], messages[6:], strict=True):
        data = bytes(STORE.serialize_cdr(message, IMAGE))
        row = 1, time_ns, data
        connection.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    connection.commit()
    bag = tmp_path / "killed"
    bag.mkdir()
    for suffix in ("", "-wal"):
        shutil.copy(f"{file}{suffix}", bag / f"killed_0.db3{suffix}")
    connection.close()
    reader = BagReader(bag)
    made_bags.assert_played(reader.frames(), frames[:6])
    assert "killed_0.db3-wal is not read" in reader.health.problem
    command = re.search("sqlite3 (.*) '(PRAGMA.*)'", reader.health.problem)
    with closing(sqlite3.connect(command[1])) as repaired:
        repaired.execute(command[2])
    _check_whole(BagReader(bag), frames)


def test_sqlite_of_eloquent_knows_no_qos(tmp_path, frames):
    with sqlite3.connect(tmp_path / "bag.db3") as connection:
        connection.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
            " serialization_format TEXT NOT NULL);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
            " timestamp INTEGER NOT NULL, data BLOB NOT NULL);"
            f"INSERT INTO topics VALUES(1, '{TOPIC}', '{IMAGE}', 'cdr');"
        )
        for received_ns, message in _rows(frames):
            data = bytes(STORE.serialize_cdr(message, IMAGE))
            connection.execute("INSERT INTO messages VALUES(NULL, 1, ?, ?)", (received_ns, data))
    _check_whole(BagReader(tmp_path / "bag.db3"), frames)


def test_receipts_of_one_moment_leave_the_order_as_it_was_written(tmp_path, frames):
    rows = [(7, made_bags.image(frame, 0)) for frame in frames]
    found = list(BagReader(write_mcap(tmp_path / "bag.mcap", rows, **UNINDEXED)).frames())
    assert all(np.array_equal(a.image, b) for a, b in zip(found, frames, strict=True))


# The stamp and the receipt of frame n, which was taken at t, and what is said of that.
Clocks = tuple[Callable[[int, int], int], Callable[[int, int], int], str]
CLOCKS: dict[str, Clocks] = {
    "receipts begin before /clock": (
        lambda _, t: t,
        lambda n, t: n if n < 5 else t,
        "gap of 1.7e+09 s between the times of receipt",
    ),
    "receipts an hour early": (lambda _, t: t, lambda _, t: t - HOUR_NS, ""),
    "receipts an hour late": (lambda _, t: t, lambda _, t: t + HOUR_NS, ""),
    "both jump": (
        lambda n, t: t + (n > 5) * HOUR_NS,
        lambda n, t: t + (n > 5) * HOUR_NS,
        "stamps: 1, the largest 3600.05 s",
    ),
    "stamps are set back by 0.3 s": (
        lambda n, t: t - (n > 5) * 300 * MS,
        lambda _, t: t,
        "stamps: 1, the largest -0.25 s",
    ),
    "stamps are set back by 100 s": (
        lambda n, t: t - (n > 5) * 100_000 * MS,
        lambda _, t: t,
        "stamps: 1, the largest -99.95 s",
    ),
    "stamps are set back and later forward": (
        lambda n, t: t + (0, -10_000 * MS, HOUR_NS)[n // 4],
        lambda _, t: t,
        "stamps: 2, the largest 3610.05 s",
    ),
    "both are set back by an hour": (
        lambda n, t: t - (n > 5) * HOUR_NS,
        lambda n, t: t - (n > 5) * HOUR_NS + MS,
        "stamps: 1, the largest -3599.95 s at 0.30 s",
    ),
    "both are set back by 0.4 s": (
        lambda n, t: t - (n > 5) * 400 * MS,
        lambda n, t: t - (n > 5) * 400 * MS,
        "stamps: 1, the largest -0.35 s at 0.30 s",
    ),
    "receipts are set back": (
        lambda _, t: t,
        lambda n, t: t - (n > 5) * HOUR_NS,
        "gap of -3599.95 s between the times of receipt",
    ),
    "receipts are set back and there are no stamps": (
        lambda _, __: 0,
        lambda n, t: t - (n > 5) * HOUR_NS,
        "stamps: 1, the largest -3599.95 s at 0.30 s",
    ),
    "stamps are set forward and later back by more": (
        lambda n, t: t + (0, HOUR_NS, -HOUR_NS)[n // 4],
        lambda _, t: t,
        "stamps: 2, the largest -7199.95 s",
    ),
    "some stamps are zero": (lambda n, t: 0 if n in (0, 4, 5, 11) else t, lambda _, t: t + MS, ""),
    # Frame 3 comes after frame 4; its delay alone is no clock that was set back.
    "a frame is late, and the recorder falls behind": (
        lambda _, t: t,
        lambda n, t: t + n * MS + (n == 3) * 60 * MS,
        "",
    ),
    "all stamps are zero": (lambda _, __: 0, lambda _, t: t + MS, ""),
}


@pytest.mark.parametrize("clocks", CLOCKS.values(), ids=CLOCKS.keys())
def test_time_goes_on_from_frame_to_frame_whatever_the_clocks_did(tmp_path, frames, clocks):
    stamp, receipt, said = clocks
    times = list(enumerate(made_bags.stamps(len(frames))))
    rows = [
        (receipt(*time), made_bags.image(frame, stamp(*time)))
        for frame, time in zip(frames, times, strict=True)
    ]
    reader = BagReader(write_mcap(tmp_path / "bag.mcap", rows))
    found = list(reader.frames())
    assert [item.stamp_ns for item in found] == [stamp(*time) for time in times]
    expected = [0.05 * number for number in range(len(frames))]
    assert [item.time_s for item in found] == pytest.approx(expected)
    assert reader.duration == pytest.approx(expected[-1])
    assert (said in reader.gaps) if said else reader.gaps == ""


def test_a_frame_without_stamp_stays_between_its_neighbours(tmp_path, frames):
    """Frame 4 was received early and frame 5, without a stamp, late: by receipts it is after 6."""
    rows = [
        (t + {4: -40, 5: 40}.get(n, 0) * MS, made_bags.image(frame, 0 if n == 5 else t))
        for n, (frame, t) in enumerate(zip(frames, made_bags.stamps(len(frames)), strict=True))
    ]
    reader = BagReader(write_mcap(tmp_path / "bag.mcap", rows))
    assert [item.stamp_ns for item in reader.frames()].index(0) == 5


def test_time_begins_with_the_first_frame_whatever_was_recorded_before(tmp_path, frames):
    info = made_bags.camera_info(frames[0], made_bags.FIRST_STAMP_NS - 10**9)
    topics = {"/rig/camera_info": [info], TOPIC: made_bags.images(frames)}
    reader = BagReader(made_bags.write(tmp_path / "bag", topics))
    assert [item.time_s for item in reader.messages()][:3] == pytest.approx([0, 0, 0.05])


@pytest.mark.parametrize(
    ("name", "encoding", "kind"),
    [
        ("sensor_msgs/Image", "ros1", f"{IMAGE} in ros1"),
        # Report: ros2/rosbag2 1245.
        ("foxglove.CompressedImage", "protobuf", "foxglove.CompressedImage in protobuf"),
    ],
)
def test_messages_in_another_encoding_are_named(tmp_path, name, encoding, kind):
    path = tmp_path / "run" / "bag.mcap"
    path.parent.mkdir()
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("", "other")
        schema = writer.register_schema(name, encoding, b"")
        writer.register_channel(TOPIC, encoding, schema)
        writer.finish()
    assert BagStorage(path).topics == {TOPIC: kind}
    # Report: ros2/rosbag2 1511; tried: "found no image among 1 entries".
    with pytest.raises(FrameSourceError, match=r"found run/, .*contains bags, such as .*/run/?$"):
        open_recording(tmp_path)


def test_a_part_that_begins_at_a_frame_has_that_frame():
    """A sum of the seconds between frames would put the one at 0.2 s before 0.2 s."""
    stamps = [7 * HOUR_NS + round(k * 1e9 / 30) for k in range(300)]
    line = timeline([StoredMessage(TOPIC, IMAGE, stamp, stamp, None) for stamp in stamps], TOPIC)
    assert [line.messages[k].time_s for k in (0, 6, 30, 75)] == [0.0, 0.2, 1.0, 2.5]
    for number, stamp in enumerate(stamps):
        start = (stamp - stamps[0]) / 1e9
        assert line.part(TimeSpan(start, start + 0.1))[0] is line.messages[number]
    # The end is not part of it: parts that follow one another share no frame.
    assert line.part(TimeSpan(0.2, 1.0))[-1] is line.messages[29]
    assert [time_s in TimeSpan(0.2, 1.0) for time_s in (0.1, 0.2, 1.0)] == [False, True, False]


def test_the_only_step_of_a_recording_is_skipped_where_it_is_a_jump():
    stamps = (HOUR_NS, 3 * HOUR_NS)
    line = timeline([StoredMessage(TOPIC, IMAGE, stamp, stamp, None) for stamp in stamps], TOPIC)
    assert line.duration == pytest.approx(1 / DEFAULT_FRAME_RATE)
    assert "the largest 7200 s" in line.gaps


@pytest.mark.parametrize("options", [{}, UNINDEXED, {"compression": CompressionType.ZSTD}], ids=str)
def test_whatever_byte_is_damaged_is_reported(tmp_path, frames, options):
    rows = _rows(frames)
    whole = write_mcap(tmp_path / "bag.mcap", rows, **options).read_bytes()
    rng = np.random.default_rng(1)
    places = [*range(8, 120), *rng.integers(8, len(whole), 100)]
    read = 0
    for at in places:
        damaged = bytearray(whole)
        damaged[at] ^= 0xFF
        (tmp_path / "damaged.mcap").write_bytes(damaged)
        try:
            reader = BagReader(tmp_path / "damaged.mcap")
            read += len(list(reader.messages()))
        except FrameSourceError:
            pass
    assert read > 0.5 * len(frames) * 100


def test_zeros_after_a_power_cut_are_passed_over(tmp_path, frames):
    path = write_mcap(tmp_path / "bag.mcap", _rows(frames), **UNINDEXED)
    end = path.read_bytes().rindex(b"\x0f\x04\x00\x00\x00\x00\x00\x00\x00")  # DataEnd
    path.write_bytes(path.read_bytes()[:end] + bytes(100_000))
    reader = BagReader(path)
    assert len(list(reader.frames())) == len(frames)
    assert "the file has no end" in reader.health.problem
