"""Bags as rosbag2 writes them: other libraries read them, and nobody waits for them."""

import threading
from pathlib import Path
from typing import Any

import made_bags
import numpy as np
import pytest
from made_bags import STORE
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_driver.bags.writer import (
    BagRecorder,
    BagWriter,
    EncodedMessage,
    RecorderState,
    Tap,
)
from cmp_tactile_processing.errors import CmpTactileError, FrameSourceError
from cmp_tactile_processing.ros.messages.definitions import message_definition

IMAGE = "sensor_msgs/msg/Image"
TOPIC = "/rig/image_raw"


def serialised(frame: np.ndarray, stamp_ns: int) -> bytes:
    return bytes(STORE.serialize_cdr(made_bags.image(frame, stamp_ns), IMAGE))


def write(folder: Path, count: int, **options: Any) -> list[int]:
    """A bag of frames of 300 kB; their times."""
    times = made_bags.stamps(count)
    with BagWriter(folder, **options) as writer:
        writer.add_topic(TOPIC, IMAGE)
        for frame, time_ns in zip(made_bags.frames(count, 480, 640), times, strict=True):
            writer.write(TOPIC, time_ns, serialised(frame, time_ns))
    return times


@pytest.mark.parametrize("compressed", [False, True])
def test_two_other_libraries_read_every_byte(tmp_path, compressed):
    times = write(tmp_path / "bag", 12, compressed=compressed)
    frames = [serialised(f, t) for f, t in zip(made_bags.frames(12, 480, 640), times, strict=True)]
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 12
        assert reader.start_time == times[0]
        assert reader.duration == times[-1] - times[0] + 1
        (connection,) = reader.connections
        assert connection.digest == STORE.hash_rihs01(IMAGE)
        found = list(reader.messages())
    assert [time_ns for _, time_ns, _ in found] == times
    assert [bytes(data) for *_, data in found] == frames
    with (tmp_path / "bag" / "bag.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary.statistics.message_count == 12
        assert summary.statistics.chunk_count == len(summary.chunk_indexes) == 3
        messages = [message for *_, message in reader.iter_messages()]
    assert [message.data for message in messages] == frames


def test_an_unknown_type_is_named():
    with pytest.raises(
        CmpTactileError, match=r"no_such_msgs/msg/Thing: found no Thing\.msg in the share"
    ):
        message_definition("no_such_msgs/msg/Thing")


class SlowEncoder:
    """Encodes nothing before it is let."""

    def __init__(self) -> None:
        self.go = threading.Event()

    def __call__(self, message: bytes) -> EncodedMessage:
        assert self.go.wait(20)
        return EncodedMessage(TOPIC, IMAGE, message)


def test_what_the_queue_cannot_hold_is_dropped_and_counted(tmp_path):
    """Whoever brings messages is not kept waiting, and what was taken is written."""
    recorder = BagRecorder(BagWriter(tmp_path / "bag"), queue_bytes=1_000_000)
    slow = SlowEncoder()
    tap = Tap(TOPIC, slow, size=300_000)
    data = serialised(made_bags.frames(1, 480, 640)[0], 1)
    for number in range(10):
        recorder.put(tap, 1 + number, data)
    assert recorder.progress.dropped == {TOPIC: 7}
    assert recorder.progress.problem == f"{TOPIC}: dropped, because writing is too slow"
    slow.go.set()
    recorder.stop()
    assert recorder.progress.state is RecorderState.FINISHED
    assert recorder.progress.messages == {TOPIC: 3}
    assert recorder.progress.queued_bytes == 0
    assert recorder.progress.duration_s == pytest.approx(2e-9)
    assert [m.time_ns for m in BagStorage(tmp_path / "bag").messages([TOPIC])] == [1, 2, 3]
    recorder.put(tap, 99, data)
    assert recorder.progress.messages == {TOPIC: 3}


def test_whatever_a_message_does_to_its_encoder_the_recording_goes_on(tmp_path):
    data = serialised(made_bags.frames(1)[0], 1)

    def encode(message: bytes) -> EncodedMessage:
        if not message:
            msg = "found nothing"
            raise FrameSourceError(msg)
        return EncodedMessage(TOPIC, IMAGE, message + b"")

    recorder = BagRecorder(BagWriter(tmp_path / "bag"), queue_bytes=1_000_000)
    tap = Tap(TOPIC, encode)
    for message in (data, "no bytes", b"", data):
        recorder.put(tap, 3, message)
    recorder.stop()
    assert recorder.progress.state is RecorderState.FINISHED
    assert recorder.progress.dropped == {TOPIC: 2}
    assert recorder.progress.problem == f"{TOPIC}: found nothing"
    assert recorder.progress.messages == {TOPIC: 2}
