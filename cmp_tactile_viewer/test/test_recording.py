"""A recording on the page: played, paused, stepped through, sought; frames and stored results."""

import itertools
from contextlib import closing
from typing import Any

import cv2
import numpy as np
import pytest
from waiting import wait_until

from cmp_tactile_bringup.command import main
from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_driver.bags.writer import BagWriter
from cmp_tactile_processing.errors import Finding, FrameSourceError
from cmp_tactile_processing.ros.messages.definitions import (
    simulation_definition,
    simulation_typestore,
)
from cmp_tactile_processing.ros.messages.making import SURFACE
from cmp_tactile_viewer import recording
from cmp_tactile_viewer.recording import StoredResults, open_source
from cmp_tactile_viewer.snapshot import Snapshot

RATE_HZ = 30.0
FRAMES = 20


class Looker:
    """Takes what a page would show."""

    def __init__(self) -> None:
        self.snapshots: list[Snapshot] = []
        self.lines: list[Finding] = []

    def show(self, sensor: str, snapshot: Snapshot) -> None:
        assert sensor == "sample_rig"
        self.snapshots.append(snapshot)

    def show_health(self, lines: list[Finding]) -> None:
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
    assert source.playback.preparing
    wait_until(lambda: source.playback.ended, "the end of the recording")
    assert not source.playback.preparing
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


def test_surfaces_alone_are_processed(results, playing, snapshots, tmp_path):
    surfaces = tmp_path / "surfaces"
    storage = BagStorage(results)
    (topic,) = (name for name in storage.topics if name.endswith("/surface"))
    with BagWriter(surfaces) as bag:
        bag.add_topic(topic, SURFACE, definition=simulation_definition(SURFACE))
        for stored in storage.messages([topic]):
            bag.write(topic, stored.time_ns, stored.data)
    source, looker = playing(surfaces)
    wait_until(lambda: source.playback.ended, "the end of the recording")
    assert len(looker.snapshots) == FRAMES
    for found, expected in zip(looker.snapshots, snapshots, strict=False):
        assert found.frame is None
        # Messages hold float32.
        assert found.force.wrench == pytest.approx(expected.force.wrench, abs=1e-4)


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
        for stored in BagStorage(grasp_bag).messages(["/sample_rig/truth/indenter_pose"])
    ]
    for pose, place in ((above, true[0].pose.position), (touch.pose, true[19].pose.position)):
        assert pose.position == (place.x, place.y, place.z)
    assert above.position != touch.pose.position
    assert not playing(results)[0].touches()


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
            storage = BagStorage(path)
            found = storage.topics.items()
            topic = next(name for name, other in found if other == kind and "/truth/" not in name)
            writer.add_topic(topic, kind)
            for stored in storage.read(storage.index([topic])):
                writer.write(topic, stored.time_ns, stored.data)
    with closing(open_source(bag, sensor)) as source:
        shown = [moment["sample_rig"] for _, moment in source.frames.read(0.0)]
    assert len(shown) == FRAMES
    assert all(item.frame is not None and item.surface is not None for item in shown)


def test_frames_of_another_size_are_named(sensor, tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.png"), np.zeros((48, 64), np.uint8))
    with pytest.raises(FrameSourceError, match="64 x 48"):
        open_source(tmp_path, sensor)
