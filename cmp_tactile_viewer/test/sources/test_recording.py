"""A recording on the page: played, paused, stepped through, sought; frames and stored results."""

from __future__ import annotations

import itertools
import threading
from typing import Any

import cv2
import numpy as np
import pytest
from waiting import wait_until

from cmp_tactile_bringup.command import main
from cmp_tactile_driver.bags.storage import open_storage
from cmp_tactile_driver.bags.writer import BagWriter
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_processing.ros.messages.definitions import simulation_typestore
from cmp_tactile_viewer.errors import ViewerError
from cmp_tactile_viewer.snapshot import HealthLine, Snapshot
from cmp_tactile_viewer.sources import recording
from cmp_tactile_viewer.sources.recording import StoredResults, open_frames, open_source

RATE_HZ = 30.0
FRAMES = 20


class Looker:
    """Takes what a page would show."""

    def __init__(self) -> None:
        self.snapshots: list[Snapshot] = []
        self.lines: list[HealthLine] = []

    def show(self, sensor: str, snapshot: Snapshot) -> None:
        assert sensor == "sample_rig"
        self.snapshots.append(snapshot)

    def show_health(self, lines: list[HealthLine]) -> None:
        self.lines = lines


@pytest.fixture(scope="module")
def results(grasp_bag, tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    assert main(["process", str(grasp_bag), "--output", str(folder)]) == 0
    return folder / "grasp.mcap"


@pytest.fixture
def playing(sensor):
    """A source that plays quickly, and who looks at it."""
    sources: list[Any] = []

    def play(path, **state):
        source = open_source(path, sensor)
        source.playback.speed, source.playback.loop = 1000.0, False
        for name, value in state.items():
            setattr(source.playback, name, value)
        sources.append(source)
        looker = Looker()
        source.start(looker)
        return source, looker

    yield play
    for source in sources:
        source.close()


def test_frames_are_processed_when_they_are_shown(grasp_bag, playing, snapshots):
    source, looker = playing(grasp_bag)
    wait_until(lambda: source.playback.ended, "the end of the recording")
    assert len(looker.snapshots) == FRAMES
    for found, expected in zip(looker.snapshots, snapshots, strict=False):
        assert found.stamp_ns == expected.stamp_ns
        assert found.frame is not None
        assert found.force.wrench == pytest.approx(expected.force.wrench, abs=1e-6)


def test_stored_results_are_shown_as_they_are(results, playing, snapshots):
    source, looker = playing(results)
    wait_until(lambda: source.playback.ended, "the end of the results")
    assert len(looker.snapshots) == FRAMES
    for found, expected in zip(looker.snapshots, snapshots, strict=False):
        assert found.frame is None
        # Positions are stored in single precision, of at most 0.03 m.
        assert found.surface.position == pytest.approx(
            expected.surface.position, abs=0.03 * 2**-23, nan_ok=True
        )
        assert found.left.corners == pytest.approx(expected.left.corners, abs=1e-4, nan_ok=True)
        assert found.left.placement == expected.left.placement


def test_the_indenter_of_a_recording_is_where_its_truth_says(grasp_bag, results, playing):
    source, looker = playing(grasp_bag, playing=False)
    touch = source.touches()["sample_rig"]
    assert touch.move is None
    wait_until(lambda: looker.snapshots, "the first frame")
    above = touch.pose
    source.playback.seek_s = 19 / RATE_HZ - 1e-3
    wait_until(lambda: len(looker.snapshots) == 2, "a frame in contact")
    true = [
        simulation_typestore().deserialize_cdr(stored.data, stored.kind)
        for stored in open_storage(grasp_bag).messages(["/sample_rig/truth/indenter_pose"])
    ]
    for pose, place in ((above, true[0].pose.position), (touch.pose, true[19].pose.position)):
        assert pose.position == (place.x, place.y, place.z)
    assert above.position != touch.pose.position
    assert not playing(results)[0].touches()


def test_the_truth_in_a_recording_is_not_taken_for_results(grasp_bag, sensor):
    assert not isinstance(open_frames(grasp_bag, sensor), StoredResults)


def test_a_paused_recording_shows_the_frame_that_is_sought_and_steps_both_ways(results, playing):
    source, looker = playing(results, playing=False)
    playback = source.playback
    wait_until(lambda: looker.snapshots, "the first frame")
    playback.seek_s = 10 / RATE_HZ - 1e-3
    wait_until(lambda: len(looker.snapshots) == 2, "the frame that was sought")
    assert playback.position_s == pytest.approx(10 / RATE_HZ, abs=1e-3)
    playback.steps = 1
    wait_until(lambda: len(looker.snapshots) == 3, "a step on")
    assert playback.position_s == pytest.approx(11 / RATE_HZ, abs=1e-3)
    playback.steps = -1
    wait_until(lambda: len(looker.snapshots) == 4, "a step back")
    assert playback.position_s == pytest.approx(10 / RATE_HZ, abs=1e-3)


def test_a_place_that_is_sought_after_the_end_is_shown_and_not_played_from(results, playing):
    source, looker = playing(results)
    playback = source.playback
    wait_until(lambda: playback.ended, "the end of the results")
    playback.seek_s = 10 / RATE_HZ - 1e-3
    wait_until(lambda: len(looker.snapshots) == FRAMES + 1, "the frame that was sought")
    assert playback.position_s == pytest.approx(10 / RATE_HZ, abs=1e-3)
    assert not playback.playing
    playback.seek_s, playback.playing = 0.0, True
    wait_until(lambda: len(looker.snapshots) == 2 * FRAMES + 1, "all frames again")


def test_a_short_recording_begins_again_at_its_end(results, sensor, playing):
    source = open_source(results, sensor)
    source.close()
    assert source.playback.loop
    _, looker = playing(results, loop=True)
    wait_until(lambda: len(looker.snapshots) > 2 * FRAMES, "the third time")
    stamps = [item.stamp_ns for item in looker.snapshots]
    assert stamps[FRAMES : 2 * FRAMES] == stamps[:FRAMES]


def test_nothing_is_read_while_nobody_looks(results, sensor, monkeypatch):
    read = []
    monkeypatch.setattr(StoredResults, "read", lambda *_: read.append(1) or iter(()))
    source = open_source(results, sensor)
    source.close()
    assert not read


@pytest.mark.parametrize("frames", [0, 1])
def test_a_recording_of_one_picture_or_none_stands_still(results, playing, monkeypatch, frames):
    """A loop would read it again and again without a pause."""
    read = StoredResults.read
    monkeypatch.setattr(
        StoredResults, "read", lambda self, start_s: itertools.islice(read(self, start_s), frames)
    )
    source, looker = playing(results, loop=True)
    wait_until(lambda: source.playback.ended, "the end")
    assert len(looker.snapshots) == frames
    assert ("no frame from 0.00 s on" in str(looker.lines)) == (not frames)


def test_it_ends_although_the_last_browser_leaves_while_it_does(results, playing, monkeypatch):
    """The source waited for another browser then, and the page for the source, without end."""
    reading, left = threading.Event(), threading.Event()
    read = StoredResults.read

    def read_slowly(self, start_s):
        reading.set()
        assert left.wait(30.0)
        yield from read(self, start_s)

    monkeypatch.setattr(StoredResults, "read", read_slowly)
    source, _ = playing(results)
    assert reading.wait(30.0)
    closing = threading.Thread(target=source.close, daemon=True)
    closing.start()
    closing.join(0.3)  # until it waits for the player
    source.pause()
    left.set()
    closing.join(30.0)
    assert not closing.is_alive()


def test_the_pace_is_that_of_the_recording(monkeypatch):
    """Times of frames over the speed, by a clock that the waiting moves."""
    now = [100.0]

    class Ended:
        def wait(self, seconds):
            now[0] += seconds
            return False

    monkeypatch.setattr(recording.time, "monotonic", lambda: now[0])
    clock, playback = recording._Clock(), recording.Playback(1.0, speed=2.0)
    for time_s in (0.0, 0.5, 0.6):
        clock.wait(time_s, playback, Ended())
    assert now[0] == pytest.approx(100.0 + 0.6 / 2.0)


@pytest.mark.parametrize("results_kind", [recording.FORCE_FIELD, recording.SURFACE])
def test_compressed_frames_are_shown_beside_recorded_results(
    grasp_bag, results, results_kind, tmp_path, sensor
):
    """As `record_compression:=png` records them: picture and surface, not the forces alone.

    Reports: ros-visualization/rqt_common_plugins 215 (compressed topics of a bag cannot be
    chosen), SJTU-ViSYS/M2DGR 35 (bags with these alone); tried: the frames are shown.
    """
    bag = tmp_path / "recorded"
    with BagWriter(bag) as writer:
        for path, kind in ((grasp_bag, recording.COMPRESSED_IMAGE), (results, results_kind)):
            storage = open_storage(path)
            found = storage.topics.items()
            topic = next(name for name, other in found if other == kind and "/truth/" not in name)
            writer.add_topic(topic, kind)
            for stored in storage.read(storage.places([topic])):
                writer.write(topic, stored.time_ns, stored.data)
    shown = [snapshot for _, snapshot in open_frames(bag, sensor).read(0.0)]
    assert len(shown) == FRAMES
    assert all(item.frame is not None and item.surface is not None for item in shown)


def test_a_step_back_finds_the_frame_before_however_long_ago(playing, monkeypatch, results):
    times = [0.0, 3.5, 9.7]
    monkeypatch.setattr(
        StoredResults,
        "read",
        lambda _, start_s: ((time_s, Snapshot(7)) for time_s in times if time_s >= start_s),
    )
    source, looker = playing(results, playing=False)
    playback = source.playback
    wait_until(lambda: looker.snapshots, "the first frame")
    playback.seek_s = 9.7
    wait_until(lambda: playback.position_s == 9.7, "the last frame")
    playback.steps = -1
    wait_until(lambda: playback.position_s == 3.5, "the frame before")


def test_results_of_several_sensors_are_refused():
    topics = {f"/{name}/surface": recording.SURFACE for name in ("left", "right")}
    with pytest.raises(ViewerError, match="found results of several sensors: /left/surface"):
        recording._result_topics("bag", topics)


def test_a_damaged_message_is_left_out_and_named(results, sensor, monkeypatch):
    frames = StoredResults(results, sensor)
    monkeypatch.setattr(
        frames, "_value", lambda *_: (_ for _ in ()).throw(ViewerError("corner_px: found 3"))
    )
    assert list(frames.read(0.0)) == []
    assert "corner_px: found 3" in frames.problem


def test_what_is_no_recording_is_named(sensor, tmp_path):
    with pytest.raises(FrameSourceError, match=r"nothing\.mcap"):
        open_source(tmp_path / "nothing.mcap", sensor)


def test_frames_of_another_size_are_named(sensor, tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.png"), np.zeros((48, 64), np.uint8))
    with pytest.raises(FrameSourceError, match="64 x 48"):
        open_source(tmp_path, sensor)
