"""`cmp_tactile calibrate force`: finds a gel that is not as described, and reports mistakes."""

import dataclasses
from functools import partial
from pathlib import Path

import cv2
import made_bags
import numpy as np
import pytest
from command_output import printed, run
from made_bags import STORE
from rosbags.rosbag2 import Reader
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing.sensor.description import (
    SensorDescription,
    load_sensor,
    write_sensor_description,
)
from cmp_tactile_processing.sensor.parts import Camera, Optics, Roi, ViewDescription
from cmp_tactile_simulation.recording.truth import read_truth

WRENCH_STEP_NS = 5_000_000
FRAME_NS = 50_000_000
# Of the reference sensor: turned, its zero off, its clock ahead.
TURN_DEG, ZERO_N, AHEAD_S = (180, 0, 90), 2.0, 0.05
# The doubt of Poisson's ratio takes a second; the tutorial's test has it.
YOUNG_ALONE = ("--poisson-std", "0")
# The gel is described stiffer than it is by this factor.
WRONG = 1.4


calibrate = partial(run, "calibrate", "force")


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
    with Reader(weigh_bag) as reader:
        (images,) = (c for c in reader.connections if c.topic.endswith("image_raw/compressed"))
        rows = [
            (images.topic, time_ns, STORE.deserialize_cdr(data, images.msgtype))
            for _, time_ns, data in reader.messages([images])
        ]
    for stamp_ns, force in reference_forces(weigh_bag):
        message = made_bags.wrench(stamp_ns + round(AHEAD_S * 1e9), [*force, 0, 0, 0])
        rows.append(("/ft/wrench", stamp_ns, message))
    return made_bags.write_rows(folder, rows)


def reference_forces(bag):
    """Stamps in ns at 200 Hz, and the force as the turned sensor has it."""
    truth, turn = read_truth(bag), Rotation.from_euler("xyz", TURN_DEG, degrees=True)
    for stamp in range(int(truth.stamp_ns[0]), int(truth.stamp_ns[-1]), WRENCH_STEP_NS):
        force = [np.interp(stamp, truth.stamp_ns, column) for column in truth.wrench[:, :3].T]
        yield stamp, turn.inv().apply(force) + ZERO_N


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


# Frames of the weighing, as often: at rest, 200 g, at rest, 500 g, at rest.
LONG = (
    5 * [0, 1, 2] + 6 * [4, 5, 6, 7, 8] + 10 * [9, 10, 11] + 6 * [*range(13, 19)] + 10 * [9, 10, 11]
)


@pytest.fixture(scope="module")
def long_weighing(weigh_bag):
    """Images at 20 Hz, and stamps and forces of a reference at 200 Hz."""
    frames, wrench = list(BagReader(weigh_bag).frames()), read_truth(weigh_bag).wrench[:, :3]
    images = [(FRAME_NS * (k + 1), frames[number].image) for k, number in enumerate(LONG)]
    stamps = np.arange(FRAME_NS, FRAME_NS * (len(LONG) + 1), WRENCH_STEP_NS)
    shown = np.rint(stamps / FRAME_NS - 1).clip(0, len(LONG) - 1).astype(int)
    return images, stamps, wrench[LONG][shown]


def low_pass(stamps, forces):
    """A filter of first order, 0.15 s."""
    kept = np.exp(-np.diff(stamps)[0] * 1e-9 / 0.15)
    return lfilter([1 - kept], [1, -kept], forces, axis=0)


SPOILT = {
    "drift": (
        lambda stamps, forces: forces - np.outer(stamps * 1e-9, (0, 0, 0.15)),
        0,
        "drifts by +0.000, +0.000, -0.150 N/s",
    ),
    "low-pass": (low_pass, 0, "ms late: --time-offset 0.1"),
    "late": (lambda _, forces: np.roll(forces, 50, axis=0), 0, "250 ms late: --time-offset 0.25"),
    "pounds": (lambda _, forces: forces / 4.448, 1, "in pounds"),
    "grams": (lambda _, forces: forces / 9.80665e-3, 1, "in grams"),
}


@pytest.mark.parametrize("how", SPOILT)
def test_what_is_wrong_with_a_reference_is_named_and_in_the_doubt(
    how, long_weighing, weigh_bag, tmp_path, capsys
):
    spoil, code, said = SPOILT[how]
    images, stamps, forces = long_weighing
    rows = [
        ("/rig/image_raw", time_ns, made_bags.image(image, time_ns)) for time_ns, image in images
    ]
    for stamp, force in zip(map(int, stamps), spoil(stamps, forces), strict=True):
        rows.append(("/ft/wrench", stamp, made_bags.wrench(stamp, [*force, 0, 0, 0])))
    bag, new = made_bags.write_rows(tmp_path / "bag", rows), tmp_path / "new.yaml"
    given = ("--wrench-topic", "/ft/wrench", *YOUNG_ALONE, "--output", new)
    assert calibrate(bag, *given, "--sensor", weigh_bag / "sensor.yaml") == code
    assert said in printed(capsys)
    if not code:
        found, true = SensorDescription.load(new).elastomer, load_sensor("sample_rig").elastomer
        assert abs(found.young / true.young - 1) < 2 * found.calibration.normal_std < 0.05


@pytest.mark.usefixtures("weights")
def test_one_view_is_refused_with_what_it_can_show(weigh_bag, tmp_path, capsys):
    sensor = load_sensor("sample_rig")
    one = tmp_path / "one.yaml"
    write_sensor_description(
        one,
        dataclasses.replace(
            sensor,
            camera=Camera("pinhole", 800.0, 800.0, 319.5, 239.5, 5 * (0.0,)),
            optics=Optics("monocular", np.eye(4), ()),
            views={"left": ViewDescription(Roi(0, 0, *sensor.frame_size))},
        ),
    )
    given = (weigh_bag, "--weights", "weights.yaml", "--output", "new.yaml")
    assert calibrate(*given, "--sensor", one) == 1
    said = printed(capsys)
    assert "does not show depth" in said
    assert "harder" not in said


def check_gel(new, bag, method, samples):
    """The gel's stiffness is found; the record says how well."""
    found, true = SensorDescription.load(new).elastomer, SensorDescription.load(bag / "sensor.yaml")
    # A percent of model error and noise.
    assert found.young == pytest.approx(true.elastomer.young, rel=0.02)
    assert found.poisson == true.elastomer.poisson
    record = found.calibration
    assert (record.method, record.samples) == (method, samples)
    assert 0 < record.normal_std < 0.2


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
