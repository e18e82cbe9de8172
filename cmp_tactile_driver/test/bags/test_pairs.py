"""What two cameras of one sensor recorded apart: pairs by stamp or name, placed in one frame."""

from dataclasses import replace

import cv2
import made_bags
import numpy as np
import pytest

from cmp_tactile_driver.bags.recording import open_recording_of
from cmp_tactile_driver.bags.timeline import TimeSpan
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.sensor.parts import Roi

MS = 10**6


@pytest.fixture
def sensor(small_sensor):
    """A frame of 128 x 48 px, in which the right view lies on the left."""
    rois = {"left": Roi(64, 0, 64, 48), "right": Roi(0, 0, 64, 48)}
    views = {name: replace(view, roi=rois[name]) for name, view in small_sensor.views.items()}
    return replace(
        small_sensor,
        image=replace(small_sensor.image, width=128, height=48),
        views=views,
        optics=replace(small_sensor.optics, type="two_view"),
    )


def write_bag(path, frames, names, shift_ns=0, *, lost=(), set_back_ns=0):
    """Left frames, and right ones that are their negatives, shifted in time, some of them lost."""
    rows = []
    for number, (frame, stamp) in enumerate(
        zip(frames, made_bags.stamps(len(frames)), strict=True)
    ):
        for name, image, shift in zip(names, (frame, 255 - frame), (0, shift_ns), strict=True):
            if name != names[1] or number not in lost:
                at = stamp + shift - set_back_ns * (number > 5)
                rows.append((name, at, made_bags.image(image, at)))
    return made_bags.write_rows(path, rows)


def write_images(folder, frames, left, right):
    for pattern, shown in ((left, frames), (right, [255 - frame for frame in frames])):
        for number, frame in enumerate(shown):
            path = folder / pattern.format(number)
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), frame)
    return folder


def assert_joined(found, frames):
    expected = [np.hstack([255 - frame, frame]) for frame in frames]
    assert all(np.array_equal(a.image, b) for a, b in zip(found, expected, strict=True))


@pytest.mark.parametrize("set_back_ns", [0, 3600 * 10**9])
@pytest.mark.parametrize(
    ("names", "topic"),
    [
        (("/rig/left/image_raw", "/rig/right/image_raw"), ""),
        (("/cam_b/image", "/cam_a/image"), "/cam_b/image, cam_a/image"),
    ],
)
def test_topics_are_paired_by_their_stamps(tmp_path, frames, sensor, names, *, topic, set_back_ns):
    bag = write_bag(tmp_path / "bag", frames, names, 3 * MS, lost=[4], set_back_ns=set_back_ns)
    recording = open_recording_of(sensor, bag, topic=topic)
    found = list(recording.messages())
    kept = [number for number in range(len(frames)) if number != 4]
    assert_joined(found, [frames[number] for number in kept])
    assert [item.time_s for item in found] == pytest.approx([0.05 * number for number in kept])
    assert "1 frames have no partner" in recording.health.summary
    assert recording.health.bad_frames == 1
    assert ("jump" in recording.gaps) == bool(set_back_ns)
    part = list(recording.messages(TimeSpan(0.25, 0.36)))
    assert_joined(part, frames[5:8])
    assert not recording.health.bad_frames


def test_pictures_that_are_far_apart_are_reported(tmp_path, frames, sensor):
    names = "/left/image_raw", "/right/image_raw"
    recording = open_recording_of(sensor, write_bag(tmp_path / "bag", frames, names, 12 * MS))
    assert_joined(recording.messages(), frames)
    assert "up to 12.0 ms apart" in recording.gaps


@pytest.mark.parametrize(
    ("left", "right", "topic"),
    [
        ("left/{}.png", "right/{}.png", ""),
        ("left{}.png", "right{}.png", ""),
        ("cam1/{:03d}.png", "cam0/{:03d}.png", "cam1,cam0"),
    ],
)
def test_images_are_paired_by_the_numbers_in_their_names(
    tmp_path, frames, sensor, *, left, right, topic
):
    folder = write_images(tmp_path / "images", frames, left, right)
    (folder / left.format(2)).unlink()
    recording = open_recording_of(sensor, folder, topic=topic)
    assert_joined(recording.messages(), frames[:2] + frames[3:])
    assert right.format(2).rpartition("/")[2] in recording.health.summary


def test_two_recordings_in_a_folder(tmp_path, frames, sensor):
    for name, shown in (("left", frames), ("right", [255 - frame for frame in frames])):
        made_bags.write(tmp_path / name, {"/image_raw": made_bags.images(shown)})
    assert_joined(open_recording_of(sensor, tmp_path).messages(), frames)


def test_what_is_no_pair_is_refused(tmp_path, frames, sensor):
    bag = write_bag(tmp_path / "bag", frames, ("/left/image_raw", "/right/image_raw"))
    with pytest.raises(FrameSourceError, match="found no images on '/top'"):
        open_recording_of(sensor, bag, topic="/left/image_raw,/top")
    with pytest.raises(FrameSourceError, match="expected one name, or LEFT,RIGHT"):
        open_recording_of(sensor, bag, topic="/a,/b,/c")
    grey = write_images(tmp_path / "grey", frames, "left{}.png", "right{}.png")
    cv2.imwrite(str(grey / "left0.png"), cv2.merge([frames[0]] * 3))
    with pytest.raises(FrameSourceError, match="expected both cameras grey or both colour"):
        list(open_recording_of(sensor, grey).messages())
    # One camera that sees both views: its topics are others.
    mirrors = replace(sensor, optics=replace(sensor.optics, type="two_mirror"))
    with pytest.raises(FrameSourceError, match="several image topics"):
        open_recording_of(mirrors, bag)
