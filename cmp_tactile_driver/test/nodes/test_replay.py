"""The node replay over real topics: nothing is lost, added or changed."""

import re
import threading
from functools import partial

import cv2
import made_bags
import numpy as np
import pytest
from ros_graph import stamps_of

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import SetBool, Trigger

from cmp_tactile_driver.bags.writer import BagWriter
from cmp_tactile_driver.nodes.replay import Replay
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.errors import CmpTactileError, FrameSourceError
from cmp_tactile_processing.measured import Surface
from cmp_tactile_processing.ros.messages.definitions import (
    bag_messages,
    simulation_definition,
    simulation_typestore,
)
from cmp_tactile_processing.ros.messages.making import SURFACE
from cmp_tactile_processing.ros.messages.reading import stamp_ns, surface_from_msg
from cmp_tactile_processing.ros.wiring import Input, WiredNode, Wiring, joining
from cmp_tactile_processing.sensor.description import load_sensor


def _pixels(message: Image) -> np.ndarray:
    channels = {"mono8": 1, "bgr8": 3}[message.encoding]
    image = np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, channels)
    return image[..., 0] if channels == 1 else image


def _ticks(clocks: list[Clock]) -> list[int]:
    return [stamp_ns(clock.clock) for clock in clocks]


@pytest.mark.alone
def test_sixty_frames_at_20_hz(ros, tmp_path):
    frames = made_bags.frames(60, 768, 1024)
    times = made_bags.stamps(60)
    messages = list(map(made_bags.compressed, frames, times))
    bag = made_bags.write(tmp_path / "bag", {"/rig/image_raw/compressed": messages})
    images, infos = ros.listen(Image, "image_raw"), ros.listen(CameraInfo, "camera_info")
    clocks, statuses = ros.listen(Clock, "/clock", depth=100), ros.statuses("replay")
    ros.start(Replay, input=str(bag), wait_for_subscribers=1, sensor_description="sample_rig")
    ros.wait(lambda: statuses.state == "finished" and len(images) == 60, "60 frames", 60.0)
    assert stamps_of(images) == times
    assert {image.header.frame_id for image in images} == {"rig_camera_optical_frame"}
    assert all(np.array_equal(_pixels(a), b) for a, b in zip(images, frames, strict=True))
    # The bag has no camera infos: they come from the sensor description, one per frame.
    assert stamps_of(infos) == times
    assert {info.k[0] for info in infos} == {733.3859777674537}
    # At most forty a second, and so fewer where two frames come in a bunch.
    ticks = _ticks(clocks)
    assert ticks == sorted({*ticks} & {*times})
    assert len(ticks) > 30
    assert statuses.values["frames out"] == "60"
    assert statuses.last.level == DiagnosticStatus.OK


@pytest.mark.parametrize("depth", [2, 1])
def test_a_slow_stage_holds_the_recording_up_unless_it_takes_the_newest(
    ros, frame_bag, frames, depth
):
    wiring, seen, statuses = Wiring(), [], ros.statuses("replay")
    gate = threading.Event()

    def work(given):
        gate.wait()
        return lambda: seen.append(stamp_ns(given.header.stamp))

    with joining(wiring):
        stage = ros.start(partial(WiredNode, "stage"))
        stage.connect_input(Input(work), Image, "image_raw", depth)
        with wiring.lock:
            stage.attach()
        ros.start(Replay, input=str(frame_bag), rate=100.0, wait_for_subscribers=1)
    if depth > 1:
        ros.wait(lambda: statuses.values.get("frames out") == "3", "the wait for room")
        gate.set()
    ros.wait(lambda: statuses.state == "finished", "the end")
    gate.set()
    last = made_bags.stamps(len(frames))[-1]
    ros.wait(lambda: seen and seen[-1] == last, "the last frame")
    ros.wait(
        lambda: int(statuses.values["passed over"]) == len(frames) - len(seen), "what was lost"
    )
    assert (len(seen) == len(frames)) == (depth > 1)
    wiring.close()


def test_recorded_camera_infos_are_kept_whole_under_the_name_of_the_sensor(ros, frame_bag, frames):
    infos = ros.listen(CameraInfo, "camera_info", depth=100)
    images = ros.listen(Image, "image_raw", depth=100)
    given = {"wait_for_subscribers": 1, "rate": 2.0, "sensor_name": "left_finger"}
    ros.start(Replay, input=str(frame_bag), **given)
    ros.wait(lambda: len(infos) == len(images) == len(frames), "frames and camera infos")
    frame_ids = {message.header.frame_id for message in (*images, *infos)}
    assert frame_ids == {"left_finger_camera_optical_frame"}
    assert stamps_of(infos) == made_bags.stamps(len(frames))
    assert list(infos[0].d) == [0.1, 0.2, 0.3, 0.4, 0.5]
    assert (infos[0].binning_x, infos[0].roi.do_rectify, infos[0].roi.width) == (2, True, 4)


def test_camera_infos_of_another_sensor_are_warned_of(ros, frame_bag, capfd):
    ros.start(Replay, input=str(frame_bag), paused=True, sensor_description="sample_rig")
    log = "".join(capfd.readouterr())
    assert "/rig/camera_info: width: found " in log
    assert "expected 1024: is sample_rig the description of this sensor?" in log


def test_folder_of_colour_images(ros, tmp_path):
    colours = np.random.default_rng(2).integers(0, 256, (5, 6, 8, 3), np.uint8)
    for number, colour in enumerate(colours):
        cv2.imwrite(str(tmp_path / f"{number}.png"), colour)
    images, infos = ros.listen(Image, "image_raw"), ros.listen(CameraInfo, "camera_info")
    ros.start(
        Replay,
        input=str(tmp_path),
        frame_rate=50.0,
        wait_for_subscribers=1,
        sensor_description="sample_rig",
    )
    ros.wait(lambda: len(images) == 5, "five images")
    assert stamps_of(images) == [n * 20_000_000 for n in range(5)]
    assert {image.header.frame_id for image in images} == {"sample_rig_camera_optical_frame"}
    assert {image.encoding for image in images} == {"bgr8"}
    assert all(np.array_equal(_pixels(a), b) for a, b in zip(images, colours, strict=True))
    # The sensor's calibration is not that of images of another size.
    assert infos == []


def test_pause_and_rate_while_it_plays(ros, frame_bag, frames):
    images, statuses = ros.listen(Image, "image_raw", depth=100), ros.statuses("replay")
    node = ros.start(Replay, input=str(frame_bag), paused=True)
    ros.wait(lambda: statuses.state == "paused", "state paused")
    ros.run(0.2)
    assert images == []
    assert node.set_parameters([Parameter("rate", value=10.0)])[0].successful
    refused = node.set_parameters([Parameter("rate", value=0.0)])[0]
    assert not refused.successful
    answer = ros.call(SetBool, "replay/pause", SetBool.Request(data=False))
    assert answer.success
    ros.wait(lambda: statuses.state == "finished" and len(images) == len(frames), "all frames")


def test_steps_and_a_jump_while_it_is_paused(ros, frame_bag, frames):
    images, statuses = ros.listen(Image, "image_raw", depth=100), ros.statuses("replay")
    infos = ros.listen(CameraInfo, "camera_info", depth=100)
    node = ros.start(Replay, input=str(frame_bag), paused=True)
    ros.wait_subscribed(node, "image_raw", "camera_info")
    ros.wait(lambda: statuses.state == "paused", "state paused")
    for count in (1, 2):
        assert ros.call(Trigger, "replay/step", Trigger.Request()).success
        ros.wait(lambda count=count: len(images) == len(infos) == count, f"frame {count}")
    assert list(infos[1].d) == [0.1, 0.2, 0.3, 0.4, 0.5]
    assert node.set_parameters([Parameter("start", value=0.35)])[0].successful
    assert ros.call(Trigger, "replay/step", Trigger.Request()).success
    ros.wait(lambda: len(images) == 3, "frame 3")
    times = made_bags.stamps(len(frames))
    assert stamps_of(images) == [times[0], times[1], times[7]]
    assert ros.call(SetBool, "replay/pause", SetBool.Request(data=False)).success
    ros.wait(lambda: statuses.state == "finished", "the end")
    answer = ros.call(Trigger, "replay/step", Trigger.Request())
    assert not answer.success
    assert answer.message == "found the state finished, expected paused"


def test_several_recordings_in_order_and_again(ros, frame_bag, image_folder, frames):
    """A loop takes the stamps, and the clock, back to the beginning."""
    images = ros.listen(Image, "image_raw", depth=200)
    clocks = ros.listen(Clock, "/clock", depth=200)
    both = f"{frame_bag}:{image_folder}"
    options = {"wait_for_subscribers": 1, "rate": 4.0, "loop": True, "frame_rate": 20.0}
    node = ros.start(Replay, input=both, **options)
    count = 2 * len(frames)
    ros.wait(lambda: len(images) > count + 3, "the second pass")
    node.destroy_node()
    first, second = made_bags.stamps(len(frames)), [n * 50_000_000 for n in range(len(frames))]
    assert stamps_of(images[: count + 3]) == [*first, *second, *first[:3]]
    assert all(
        np.array_equal(_pixels(a), b) for a, b in zip(images, [*frames, *frames], strict=False)
    )
    ticks = _ticks(clocks)
    assert first[0] in ticks[ticks.index(second[0]) :]


def test_truncated_bag_is_played_and_reported(ros, tmp_path):
    messages = made_bags.images(made_bags.frames(20, 480, 640))
    bag = made_bags.write(tmp_path / "bag", {"/image_raw": messages})
    file = next(bag.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    images, statuses = ros.listen(Image, "image_raw", depth=100), ros.statuses("replay")
    ros.start(Replay, input=str(bag), wait_for_subscribers=1, rate=4.0)
    ros.wait(lambda: statuses.state == "finished", "the end")
    count = int(statuses.values["frames out"])
    ros.wait(lambda: len(images) == count, "what was sent")
    assert 5 <= count < 11
    assert statuses.last.level == DiagnosticStatus.WARN
    assert f"{count} of 20 messages can be read" in statuses.last.message


def test_wrong_encoding_throughout_is_an_error(ros, tmp_path, frames, capfd):
    """In the diagnostics, in the log, and for the container."""
    messages = [made_bags.image(frame, 0, encoding="32FC1") for frame in frames]
    bag = made_bags.write(tmp_path / "bag", {"/image_raw": messages})
    reports = ros.reports("replay")
    node = ros.start(Replay, input=str(bag))
    ros.wait(lambda: reports.last.level == DiagnosticStatus.ERROR, "a diagnostic of level ERROR")
    assert "no frame can be used" in reports.last.message
    assert "encoding: found '32FC1'" in reports.last.message
    assert "encoding: found '32FC1'" in node.failure
    log = "".join(capfd.readouterr())
    assert re.search(r"\[ERROR\].*failed: .*no frame can be used: .*found '32FC1'", log)


@pytest.mark.parametrize(
    ("parameters", "error", "message"),
    [
        ({}, FrameSourceError, "parameter input: found nothing"),
        ({"input": "/nowhere"}, FrameSourceError, "/nowhere: found no such file"),
        ({"input": "/nowhere", "rate": 0.0}, CmpTactileError, "rate"),
        ({"input": "/nowhere", "rate": 2}, CmpTactileError, "rate"),
        ({"input": "/nowhere", "sensor_description": "x"}, CmpTactileError, "x: found no such"),
    ],
)
def test_wrong_parameters_stop_the_constructor(ros, parameters, error, message):
    with pytest.raises(error, match=message):
        ros.start(Replay, **parameters)
    ros.run(0.1)
    assert "replay" not in ros.node.get_node_names()


def _surface_bag(path, sensor, stamps):
    """Surfaces of a gel that sinks by 1 um a frame."""
    rest = sensor.pattern.corners()
    make, store = bag_messages(), simulation_typestore()
    with BagWriter(path) as bag:
        bag.add_topic("/finger/surface", SURFACE, definition=simulation_definition(SURFACE))
        for number, stamp in enumerate(stamps):
            surface = Surface.from_positions(
                sensor.pattern.shape, rest, rest - [0, 0, 1e-6 * number]
            )
            message = make.surface(surface, make.header(stamp, "finger"))
            bag.write("/finger/surface", stamp, store.serialize_cdr(message, SURFACE))
    return path


def test_surfaces_of_a_sensor_without_a_camera(ros, tmp_path, frame_bag):
    sensor, stamps = load_sensor("tac3d_ad2"), made_bags.stamps(5)
    bag = _surface_bag(tmp_path / "surfaces", sensor, stamps)
    surfaces, statuses = ros.listen(SurfaceMsg, "surface"), ros.statuses("replay")
    given = {"sensor_description": "tac3d_ad2", "wait_for_subscribers": 1}
    ros.start(Replay, input=str(bag), **given)
    ros.wait(lambda: statuses.state == "finished" and len(surfaces) == 5, "five surfaces")
    assert stamps_of(surfaces) == stamps
    assert surfaces[0].header.frame_id == "tac3d_ad2_gel_frame"
    last = surface_from_msg(surfaces[-1], sensor.pattern.shape)
    assert last.displacement[..., 2] == pytest.approx(-4e-6)
    with pytest.raises(FrameSourceError, match=r"surfaces in some .* images in others"):
        ros.start(Replay, input=f"{bag}:{frame_bag}", **given)
