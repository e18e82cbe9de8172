"""Bags as rosbag2 writes them: other libraries read them, and we what is left of a damaged one."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_driver.bags.recorder import BagRecorder, EncodedMessage, RecorderState, Tap
from cmp_tactile_driver.bags.storage import open_storage
from cmp_tactile_driver.bags.writer import BagWriter, SplitLimits
from cmp_tactile_driver.errors import BagError, BagWriteError
from cmp_tactile_processing.errors import MessageDefinitionError
from cmp_tactile_processing.ros.messages.definitions import message_definition

STORE = get_typestore(Stores.ROS2_JAZZY)
IMAGE = "sensor_msgs/msg/Image"
TOPIC = "/rig/image_raw"
# A chunk, which is the least that is lost of a damaged file.
CHUNK_BYTES = 2**20


def serialised(frame: np.ndarray, stamp_ns: int, bags: Any) -> bytes:
    return bytes(STORE.serialize_cdr(bags.image(frame, stamp_ns), IMAGE))


def write(folder: Path, bags: Any, count: int, **options: Any) -> list[int]:
    """A bag of frames of 300 kB; their times."""
    times = bags.stamps(count)
    with BagWriter(folder, **options) as writer:
        writer.add_topic(TOPIC, IMAGE)
        for frame, time_ns in zip(bags.frames(count, 480, 640), times, strict=True):
            writer.write(TOPIC, time_ns, serialised(frame, time_ns, bags), time_ns - 7)
    return times


@pytest.mark.parametrize("compressed", [False, True])
def test_two_other_libraries_read_every_byte_and_both_times(tmp_path, bags, compressed):
    times = write(tmp_path / "bag", bags, 12, compressed=compressed)
    frames = [serialised(f, t, bags) for f, t in zip(bags.frames(12, 480, 640), times, strict=True)]
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 12
        assert reader.start_time == times[0]
        assert reader.duration == times[-1] - times[0] + 1
        (connection,) = reader.connections
        assert connection.digest == STORE.hash_rihs01(IMAGE)
        found = list(reader.messages())
    assert [time_ns for _, time_ns, _ in found] == times
    assert [bytes(data) for *_, data in found] == frames
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary.statistics.message_count == 12
        assert summary.statistics.chunk_count == len(summary.chunk_indexes) == 3
        messages = [message for *_, message in reader.iter_messages()]
    assert [message.publish_time for message in messages] == [t - 7 for t in times]
    assert [message.data for message in messages] == frames


@pytest.mark.parametrize("kind", [IMAGE, "diagnostic_msgs/msg/DiagnosticArray"])
def test_definitions_and_hashes_are_those_that_rosbags_knows(kind):
    found = message_definition(kind)
    assert found.type_hash == STORE.hash_rihs01(kind)
    own = get_typestore(Stores.EMPTY)
    own.register(get_types_from_msg(found.text, kind))
    assert own.fielddefs.keys() >= {kind, "std_msgs/msg/Header", "builtin_interfaces/msg/Time"}
    assert all(own.fielddefs[name][1] == STORE.fielddefs[name][1] for name in own.fielddefs)


def test_an_unknown_type_is_named():
    with pytest.raises(
        MessageDefinitionError, match=r"no_such_msgs/msg/Thing: found no Thing\.msg in the share"
    ):
        message_definition("no_such_msgs/msg/Thing")


@pytest.mark.parametrize(
    ("limits", "files"),
    [
        (SplitLimits(), 1),
        # A file is full with the fourth frame of 307 kB.
        (SplitLimits(size_bytes=10**6), 3),
        # Frames are 50 ms apart.
        (SplitLimits(duration_ns=249_000_000), 3),
    ],
)
def test_files_of_limited_size_and_duration_are_one_bag(tmp_path, bags, limits, files):
    times = write(tmp_path / "bag", bags, 12, limits=limits)
    found = sorted(path.name for path in (tmp_path / "bag").glob("*.mcap"))
    assert found == [f"bag_{number}.mcap" for number in range(files)]
    assert [frame.time_ns for frame in BagReader(tmp_path / "bag").frames()] == times


@pytest.mark.parametrize("compressed", [False, True])
def test_what_is_left_of_a_recording_that_was_killed(tmp_path, bags, compressed):
    """In its second file: no metadata.yaml, no index there, and a chunk written in part."""
    bag = tmp_path / "bag"
    limits = SplitLimits(duration_ns=299_000_000)
    times = write(bag, bags, 12, compressed=compressed, limits=limits)
    (bag / "metadata.yaml").unlink()
    last = bag / "bag_1.mcap"
    last.write_bytes(last.read_bytes()[: CHUNK_BYTES * 3 // 2])
    reader = BagReader(bag)
    # Six frames of the first file, and the four of the other's one whole chunk.
    assert [frame.time_ns for frame in reader.frames()] == times[:10]
    assert "10 messages can be read, any after them are lost" in reader.loss


@pytest.mark.parametrize("distribution", ["jazzy", ""])
def test_the_metadata_name_the_distribution_that_is_sourced(tmp_path, monkeypatch, distribution):
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    if distribution:
        monkeypatch.setenv("ROS_DISTRO", distribution)
    BagWriter(tmp_path / "bag").close()
    metadata = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text(encoding="utf-8"))
    assert metadata["rosbag2_bagfile_information"]["ros_distro"] == distribution


def test_a_folder_that_is_there_is_left_alone(tmp_path):
    with pytest.raises(BagWriteError, match="exists already, expected a place for a new bag"):
        BagWriter(tmp_path)
    assert not list(tmp_path.iterdir())


class SlowEncoder:
    """Encodes nothing before it is let."""

    def __init__(self) -> None:
        self.go = threading.Event()

    def __call__(self, message: bytes) -> EncodedMessage:
        assert self.go.wait(20)
        return EncodedMessage(TOPIC, IMAGE, message, None)


def test_what_the_queue_cannot_hold_is_dropped_and_counted(tmp_path, bags):
    """Whoever brings messages is not kept waiting, and what was taken is written."""
    recorder = BagRecorder(BagWriter(tmp_path / "bag"), queue_bytes=1_000_000)
    slow = SlowEncoder()
    tap = Tap(TOPIC, slow, size=300_000)
    data = serialised(bags.frames(1, 480, 640)[0], 1, bags)
    for number in range(10):
        recorder.put(tap, 1 + number, data)
    assert recorder.progress.dropped == {TOPIC: 7}
    assert recorder.progress.problem == f"{TOPIC}: dropped, because writing is too slow"
    slow.go.set()
    recorder.stop()
    assert recorder.progress.state is RecorderState.FINISHED
    assert recorder.progress.messages == {TOPIC: 3}
    assert recorder.progress.queued_bytes == 0
    assert [m.time_ns for m in open_storage(tmp_path / "bag").messages([TOPIC])] == [1, 2, 3]
    recorder.put(tap, 99, data)
    assert recorder.progress.messages == {TOPIC: 3}


def test_a_message_that_cannot_be_encoded_is_counted_and_the_next_is_written(tmp_path, bags):
    data = serialised(bags.frames(1)[0], 1, bags)

    def encode(message: bytes) -> EncodedMessage:
        if not message:
            msg = "found nothing"
            raise BagError(msg)
        return EncodedMessage(TOPIC, IMAGE, message, 5)

    recorder = BagRecorder(BagWriter(tmp_path / "bag"), queue_bytes=1_000_000)
    tap = Tap(TOPIC, encode)
    for message in (data, b"", data):
        recorder.put(tap, 1, message)
    recorder.stop()
    assert recorder.progress.dropped == {TOPIC: 1}
    assert recorder.progress.problem == f"{TOPIC}: found nothing"
    assert len(list(BagReader(tmp_path / "bag").frames())) == 2


def test_whatever_a_message_does_to_its_encoder_the_recording_goes_on(tmp_path, bags):
    data = serialised(bags.frames(1)[0], 1, bags)

    def encode(message: bytes) -> EncodedMessage:
        return EncodedMessage(TOPIC, IMAGE, message + b"", -1)

    recorder = BagRecorder(BagWriter(tmp_path / "bag"), queue_bytes=1_000_000)
    tap = Tap(TOPIC, encode)
    for message in (data, "no bytes", data):
        recorder.put(tap, 3, message)
    recorder.stop()
    assert recorder.progress.state is RecorderState.FINISHED
    assert recorder.progress.dropped == {TOPIC: 1}
    # Of a stamp before 1970, which MCAP does not know, the time of coming is written.
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        times = [(m.log_time, m.publish_time) for *_, m in make_reader(file).iter_messages()]
    assert times == [(3, 3), (3, 3)]


def test_a_file_that_cannot_be_begun_leaves_the_others_counted_once(tmp_path, bags):
    writer = BagWriter(tmp_path / "bag")
    writer.add_topic(TOPIC, IMAGE)
    writer.write(TOPIC, 7, serialised(bags.frames(1)[0], 7, bags))
    (tmp_path / "bag" / "bag_1.mcap").mkdir()
    with pytest.raises(BagWriteError, match="cannot be written"):
        writer.split()
    writer.close()
    assert writer.file_count == 1
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 1
        assert len(list(reader.messages())) == 1
