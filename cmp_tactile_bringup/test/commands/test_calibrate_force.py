"""`cmp_tactile calibrate force`: finds a gel that is not as described, and reports mistakes."""

import dataclasses
import itertools
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_output import printed
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from cmp_tactile_bringup.command import main
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing.sensor.description import SensorDescription, write_sensor_description
from cmp_tactile_simulation.recording.truth import read_truth

STORE = get_typestore(Stores.ROS2_JAZZY)
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
WRENCH_STEP_NS = 5_000_000
FRAME_NS = 50_000_000
# Of the reference sensor: turned, its zero off, its clock ahead.
TURN_DEG, ZERO_N, AHEAD_S = (180, 0, 90), 2.0, 0.05
# The doubt of Poisson's ratio takes a second; the tutorial's test has it.
YOUNG_ALONE = ("--poisson-std", "0")
# The gel is described stiffer than it is by this factor.
WRONG = 1.4


def calibrate(*arguments):
    return main(["calibrate", "force", *map(str, arguments)])


@pytest.fixture(scope="module")
def wrong_sensor(weigh_bag, tmp_path_factory):
    """A description whose gel is stiffer than the recorded one."""
    path = tmp_path_factory.mktemp("wrong") / "wrong.yaml"
    sensor = SensorDescription.load(weigh_bag / "sensor.yaml")
    gel = sensor.elastomer
    layer = dataclasses.replace(gel.shading_layer, young=WRONG * gel.shading_layer.young)
    gel = dataclasses.replace(gel, young=WRONG * gel.young, shading_layer=layer)
    write_sensor_description(path, dataclasses.replace(sensor, elastomer=gel))
    return path


@pytest.fixture(scope="module")
def wrench_bag(weigh_bag, tmp_path_factory):
    """The images of the weighing with what a force sensor under the gel measured, /ft/wrench."""
    folder = tmp_path_factory.mktemp("wrench") / "bag"
    with (
        Reader(weigh_bag) as reader,
        Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        (images,) = (c for c in reader.connections if c.topic.endswith("image_raw/compressed"))
        topic = writer.add_connection(images.topic, images.msgtype, typestore=STORE)
        for _, time_ns, data in reader.messages([images]):
            writer.write(topic, time_ns, data)
        topic = writer.add_connection("/ft/wrench", WRENCH_STAMPED, typestore=STORE)
        for stamp_ns, force in reference_forces(weigh_bag):
            message = wrench_message(stamp_ns + round(AHEAD_S * 1e9), force)
            writer.write(topic, stamp_ns, STORE.serialize_cdr(message, WRENCH_STAMPED))
    return folder


def reference_forces(bag):
    """Stamps in ns at 200 Hz, and the force as the turned sensor has it."""
    truth, turn = read_truth(bag), Rotation.from_euler("xyz", TURN_DEG, degrees=True)
    for stamp in range(int(truth.stamp_ns[0]), int(truth.stamp_ns[-1]), WRENCH_STEP_NS):
        force = [np.interp(stamp, truth.stamp_ns, column) for column in truth.wrench[:, :3].T]
        yield stamp, turn.inv().apply(force) + ZERO_N


def wrench_message(stamp_ns, force):
    types = STORE.types
    vector = types["geometry_msgs/msg/Vector3"]
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    wrench = types["geometry_msgs/msg/Wrench"](vector(*map(float, force)), vector(0.0, 0.0, 0.0))
    return types[WRENCH_STAMPED](types["std_msgs/msg/Header"](stamp, "ft"), wrench)


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """The file of the two weights, in the current folder."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "weights.yaml"
    path.write_text("loads:\n  - {mass: 0.2, time: [0.3, 0.57]}\n  - {mass: 0.5}\n")
    return path


def test_a_reference_sensor_beside_it_finds_the_gel(
    weigh_bag, wrench_bag, wrong_sensor, tmp_path, capsys
):
    new = tmp_path / "new.yaml"
    turn = ("--wrench-rotation", *TURN_DEG)
    clock = ("--time-offset", AHEAD_S)
    given = ("--wrench-topic", "/ft/wrench", *turn, *clock, "--sensor", wrong_sensor, *YOUNG_ALONE)
    assert calibrate(wrench_bag, *given, "--output", new) == 0, printed(capsys)
    assert "Offset of the reference sensor" in printed(capsys)
    check_gel(new, weigh_bag, "force_sensor", 2)


def check_gel(new, bag, method, samples):
    """The gel's stiffness is found; the record says how well."""
    found, true = SensorDescription.load(new).elastomer, SensorDescription.load(bag / "sensor.yaml")
    # A percent of model error and noise.
    assert found.young == pytest.approx(true.elastomer.young, rel=0.02)
    assert found.poisson == true.elastomer.poisson
    record = found.calibration
    assert (record.method, record.samples) == (method, samples)
    assert 0 < record.normal_std < 0.2


@pytest.mark.ros
def test_running_sensors_are_recorded_together(ros, weigh_bag):
    """Frames and wrenches of a short while, by their stamps."""
    pytest.importorskip("rclpy")
    from geometry_msgs.msg import WrenchStamped
    from sensor_msgs.msg import Image
    from std_msgs.msg import Header

    from cmp_tactile_bringup.calibration.live import LiveReference
    from cmp_tactile_processing.ros.messages.conversions import image_to_msg

    images = [frame.image for frame in BagReader(weigh_bag).frames()][:12]
    camera = ros.node.create_publisher(Image, "image_raw", 2)
    reference = ros.node.create_publisher(WrenchStamped, "wrench", 2)
    ended = threading.Event()

    def publish():
        for number in itertools.count():
            if ended.wait(0.05):
                return
            header = Header()
            header.stamp.sec, header.stamp.nanosec = divmod(FRAME_NS * number, 10**9)
            message = WrenchStamped(header=header)
            message.wrench.force.z = -float(number)
            reference.publish(message)
            camera.publish(image_to_msg(images[min(number // 4, 11)], "mono8", header))

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        frames, wrenches = (f"{ros.namespace}/{name}" for name in ("image_raw", "wrench"))
        sensor = SensorDescription.load(weigh_bag / "sensor.yaml")
        with LiveReference(frames, sensor, 20.0, wrenches) as live:
            motion, series = live.record(1.0, lambda *_: None)
    finally:
        ended.set()
        thread.join()
    assert len(motion.stamp_ns) > 1
    assert set(motion.stamp_ns) <= set(FRAME_NS * np.arange(10_000))
    np.testing.assert_allclose(series.force[:, 2], -series.stamp_ns / FRAME_NS)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("bag", "--output", "o.yaml"), "one of --weights, --wrench-topic and --mass"),
        (("bag", "--weights", "w", "--mass", "1", "--output", "o.yaml"), "not allowed with"),
        (
            ("--wrench-topic", "/f", "--sensor", "s", "--output", "o.yaml"),
            "--wrench-topic needs INPUT, or",
        ),
        (("--weights", "w", "--output", "o.yaml"), "--sensor is required"),
        (("--mass", "1", "--sensor", "s", "--output", "o.yaml"), "needs the --topic of a running"),
        (
            ("--mass", "1", "--topic", "/t", "--sensor", "s", "--output", "o.yaml"),
            "--mass needs a terminal",
        ),
        (("bag", "--weights", "w", "--rest", "2", "1", "--output", "o.yaml"), "FROM must be below"),
        (("bag", "--weights", "w", "--poisson-std", "9", "--output", "o.yaml"), "from 0 to 0.1"),
    ],
)
def test_a_wrong_usage_is_reported_before_any_work(arguments, complaint, capsys):
    with pytest.raises(SystemExit) as ended:
        calibrate(*arguments)
    assert ended.value.code == 2
    assert complaint in printed(capsys)


@pytest.mark.usefixtures("weights")
@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("nowhere", "--weights", "weights.yaml"), "nowhere: found no such file or folder"),
        (("BAG", "--weights", "nowhere.yaml"), "nowhere.yaml: cannot be read"),
        (("BAG", "--weights", "w.yaml", "--output", "n.txt"), "found the suffix '.txt'"),
        (("BAG", "--wrench-topic", "/f"), "found no geometry_msgs/msg/WrenchStamped on '/f'"),
        (("WRENCH", "--wrench-topic", "/ft/wrench", "--time-offset", "99"), "expected some within"),
        (("small", "--weights", "weights.yaml"), "found 16 x 12 px, expected 1024 x 768 px"),
    ],
)
def test_a_wrong_input_is_one_line(arguments, complaint, weigh_bag, wrench_bag, capsys):
    Path("small").mkdir()
    cv2.imwrite("small/0.png", np.zeros((12, 16), np.uint8))
    bags = {"BAG": str(weigh_bag), "WRENCH": str(wrench_bag)}
    given = [bags.get(item, item) for item in arguments]
    if "--output" not in given:
        given += ["--output", "new.yaml"]
    assert calibrate(*given, "--sensor", "sample_rig") == 1
    said = printed(capsys)
    assert said.count("error: ") == 1
    assert complaint in said
    assert not Path("new.yaml").exists()
