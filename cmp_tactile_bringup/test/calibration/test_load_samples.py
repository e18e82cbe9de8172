"""What `cmp_tactile calibrate force` reads: loads, steady frames, a reference sensor's topic."""

import dataclasses

import made_bags
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmp_tactile_bringup.calibration.gel_recording import (
    GelMotion,
    leading_frames,
    read_motion,
    steady_stretches,
)
from cmp_tactile_bringup.calibration.loads import (
    WrenchSeries,
    at_frames,
    averaged,
    fixed_rotation,
    read_known_loads,
    read_wrench,
    samples_of_weights,
)
from cmp_tactile_bringup.calibration.reference_sensor import (
    SensorSampling,
    lag_s,
    samples_of_sensor,
    zeroed,
)
from cmp_tactile_bringup.commands.calibrate.sources import WrenchSensor, force_at_frames
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing.errors import FrameSourceError, InputError
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.recording.truth import read_truth

FRAME_NS = 33_333_333
NOISE_M = 3e-6


def written(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def write_wrench_bag(folder, rows):
    """A bag with WrenchStamped messages; rows: log time and stamp in ns, six numbers."""
    messages = [
        ("/ft/wrench", log_ns, made_bags.wrench(stamp_ns, wrench))
        for log_ns, stamp_ns, wrench in rows
    ]
    return made_bags.write_rows(folder, messages)


def pressed_motion(depth, seed=3):
    """A gel whose middle is pressed in by depth (n,) m, with noise; 8 x 9 markers."""
    random = np.random.default_rng(seed)
    count = len(depth)
    displacement = random.normal(0, NOISE_M, (count, 8, 9, 3))
    displacement[:, 2:6, 3:6, 2] -= np.asarray(depth)[:, None, None]
    status = np.ones((count, 8, 9), np.uint8)
    stamps = 10**9 + FRAME_NS * np.arange(count, dtype=np.int64)
    return GelMotion("press", stamps, displacement, status, leading_frames(displacement, 50))


# At rest, pressed further and further, held, and let go.
DEPTH = np.concatenate([np.zeros(6), np.linspace(0, 2e-4, 8), np.full(9, 2e-4), np.zeros(5)])


def test_steady_frames_are_those_that_noise_explains():
    motion = pressed_motion(DEPTH)
    assert motion.rest == range(7)  # the first step of the press is 0
    assert steady_stretches(motion.displacement, 4) == [range(7), range(13, 23), range(23, 28)]
    # And where the reference force changes, a stretch ends.
    force = np.zeros((len(DEPTH), 3))
    force[18:, 2] = -0.5
    stretches = steady_stretches(motion.displacement, 4, force)
    assert stretches == [range(7), range(13, 18), range(18, 23), range(23, 28)]


def test_a_marker_that_is_mostly_hidden_is_missing_from_the_mean():
    motion = pressed_motion(np.zeros(4))
    motion.status[1:, 0, 0] = 0
    motion.status[0, 0, 1] = 0
    motion.displacement[motion.status == 0] = np.nan
    mean, status = averaged(motion, range(4))
    assert np.isnan(mean[0, 0]).all()
    assert status[0, 0] == 0
    assert status[0, 1] == 1
    np.testing.assert_allclose(mean[0, 1], motion.displacement[1:, 0, 1].mean(axis=0))


def test_known_loads_are_read_with_their_direction_and_doubt(tmp_path):
    (tmp_path / "second").mkdir()
    loads, rest = read_known_loads(
        written(
            tmp_path / "weights.yaml",
            "gravity: 9.8\nrest: [0, 0.2]\nloads:\n"
            "  - {mass: 0.2, time: [0.5, 1]}\n"
            "  - {mass: 2, std: 0.01, direction: [0, 0.6, -0.8], recording: second}\n"
            "  - {force: [1, 0, -2], std: 0.05, name: spring}\n",
        )
    )
    assert rest == (0, 0.2)
    straight, tilted, spring = loads
    np.testing.assert_allclose(straight.force, [0, 0, -1.96])
    # 0.2 % of the mass; a degree askew.
    np.testing.assert_allclose(straight.std, [0.0342, 0.0342, 0.00392], rtol=1e-3)
    assert (straight.name, straight.time_s, straight.recording) == ("200 g", (0.5, 1), None)
    np.testing.assert_allclose(tilted.force, [0, 11.76, -15.68])
    assert tilted.recording == tmp_path / "second"
    assert tilted.std[2] > 0.01 * 9.8 * 0.8
    assert spring.name == "spring"
    np.testing.assert_allclose(spring.std, 0.05)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("loads: []", r"loads: found \[\], expected a list of known loads"),
        ("loads:\n  - {mass: 200}", r"loads\[0\].mass: found 200, expected .* at most 100 kg"),
        ("loads:\n  - {mas: 1}", r"loads\[0\]\.mas: found 1, expected no such key; .*'mass'"),
        ("loads:\n  - {mass: 1, tim: [0, 1]}", r"loads\[0\].tim: found .* no such key; allowed"),
        ("loads:\n  - {mass: 1, time: [2, 1]}", r"loads\[0\].time: .*from below to"),
        ("loads:\n  - {force: [0, 0, 0]}", "expected a force above 0"),
        ("loads:\n  - {mass: 1}\ngravity: 1.6", "gravity: found 1.6"),
        (
            "rest: [0, 3]\nloads:\n  - {mass: 1, time: [2, 4]}",
            r"loads\[0\].time: found \[2, 4\], expected .*rest.*, \[0.0, 3.0\]",
        ),
    ],
)
def test_a_wrong_file_of_loads_names_key_found_and_expected(text, complaint, tmp_path):
    path = written(tmp_path / "weights.yaml", text)
    with pytest.raises(InputError, match=complaint) as raised:
        read_known_loads(path)
    assert str(path) in str(raised.value)


def loads_of(tmp_path, text):
    return read_known_loads(written(tmp_path / "weights.yaml", text))[0]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{mass: 0.2, time: [7, 8]}", r"200 g: time: found no frame from 7 to 8 s.*0\.90 s"),
        ("{mass: 0.2}", r"found 0 times \(never\) .* 12 frames or more, expected 1; .*`time`"),
    ],
)
def test_a_load_that_no_frame_shows_is_reported(text, complaint, tmp_path):
    (load,) = loads_of(tmp_path, f"loads:\n  - {text}")
    with pytest.raises(FrameSourceError, match=complaint):
        samples_of_weights([load], {None: pressed_motion(DEPTH)}, 12)


def test_weights_without_times_are_the_still_presses_one_after_another(tmp_path):
    depth = np.concatenate([DEPTH, 2 * DEPTH])
    motion = pressed_motion(depth)
    loads = loads_of(tmp_path, "loads:\n  - {mass: 0.2}\n  - {mass: 0.4}")
    samples = samples_of_weights(loads, {None: motion}, 6)
    deepest = [np.nanmin(sample.displacement[..., 2]) for sample in samples]
    np.testing.assert_allclose(deepest, [-2e-4, -4e-4], atol=1e-5)
    with pytest.raises(FrameSourceError, match=r"2 times \(0\.43 to 0\.73 s, .*expected 3"):
        samples_of_weights([*loads, loads[0]], {None: motion}, 6)


def test_a_force_is_turned_and_reversed_into_the_gel_frame():
    turn = Rotation.from_euler("xyz", (180, 0, 90), degrees=True)
    force = np.array([[0.3, 0.1, -2.0]])
    there = turn.inv().apply(force)
    motion = pressed_motion([0.0, 0.0])
    for reaction, read in ((False, there), (True, -there)):
        series = WrenchSeries("bag", motion.stamp_ns, np.tile(read, (2, 1)))
        options = WrenchSensor(wrench_rotation=(180, 0, 90), wrench_reaction=reaction)
        on_gel = force_at_frames(options, load_sensor("sample_rig"), motion, series)
        np.testing.assert_allclose(on_gel, np.tile(force, (2, 1)), atol=1e-12)


def test_a_wrench_topic_is_read_by_stamps_and_by_log_times_without_them(tmp_path):
    rows = [(5 * 10**9 + k, (10**9 + k) * (k > 0), [k, 0, 0, 0, 0, 1]) for k in range(3)]
    series = read_wrench(write_wrench_bag(tmp_path / "bag", rows), "/ft/wrench")
    assert series.stamp_ns.tolist() == [10**9, 10**9 + 1, 10**9 + 2]
    np.testing.assert_allclose(series.force, [[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    rows = [(log_ns, 0, wrench) for log_ns, _, wrench in rows]
    series = read_wrench(write_wrench_bag(tmp_path / "unstamped", rows), "ft/wrench")
    assert series.stamp_ns.tolist() == [5 * 10**9 + k for k in range(3)]


def test_a_clock_that_is_set_back_exchanges_neither_frames_nor_forces(weigh_bag, tmp_path):
    """By less than the recording lasts: what came after would lie beside what came before."""
    sensor = load_sensor(str(weigh_bag / "sensor.yaml"))
    frames = list(BagReader(weigh_bag).frames())
    half = len(frames) // 2
    back_ns = frames[half].stamp_ns - frames[2].stamp_ns

    def clock(time_ns):
        return time_ns - back_ns * (time_ns >= frames[half].stamp_ns)

    rows = []
    for frame in frames:
        stamp = clock(frame.stamp_ns)
        rows.append(("/rig/image_raw", stamp, made_bags.image(frame.image, stamp)))
        elapsed_s = (frame.stamp_ns - frames[0].stamp_ns) * 1e-9
        rows.append(("/ft/wrench", stamp, made_bags.wrench(stamp, [elapsed_s, 0, 0, 0, 0, 0])))
    bag = made_bags.write_rows(tmp_path / "set_back", rows)
    whole, motion = read_motion(weigh_bag, sensor), read_motion(bag, sensor)
    np.testing.assert_array_equal(motion.displacement, whole.displacement)
    # Where the clock was set, the usual time passes.
    np.testing.assert_allclose(motion.time_s, whole.time_s, atol=1e-9)
    force = at_frames(read_wrench(bag, "/ft/wrench"), motion.stamp_ns, 0.0)
    np.testing.assert_allclose(force[:, 0], whole.time_s, atol=1e-9)
    (found,) = motion.findings
    assert f"at {whole.time_s[half]:.2f} s" in found.text


def test_a_wrench_topic_of_too_few_numbers_is_refused(tmp_path):
    bag = write_wrench_bag(tmp_path / "bag", [(1, 1, np.zeros(6))])
    with pytest.raises(FrameSourceError, match="/ft/wrench: found 1 messages, expected two"):
        read_wrench(bag, "/ft/wrench")
    bag = write_wrench_bag(tmp_path / "nan", [(k, k, np.full(6, np.nan)) for k in range(1, 4)])
    with pytest.raises(FrameSourceError, match=r"found 0 messages and 3 .*NaN, expected"):
        read_wrench(bag, "/ft/wrench")


def test_fixed_transforms_are_followed_from_frame_to_frame_both_ways(tmp_path):
    types = made_bags.STORE.types
    turn = Rotation.from_euler("xyz", (180, 0, 90), degrees=True)
    edges = {("base", "gel"): (0.0, 0.0, 0.1), ("base", "ft"): (0.02, 0.0, 0.0)}
    stamped = types["geometry_msgs/msg/TransformStamped"]
    items = []
    for (parent, child), place in edges.items():
        quaternion = types["geometry_msgs/msg/Quaternion"](
            *(turn.as_quat() if child == "ft" else (0.0, 0.0, 0.0, 1.0))
        )
        transform = types["geometry_msgs/msg/Transform"](made_bags.vector(place), quaternion)
        items.append(stamped(made_bags.header(0, parent), child, transform))
    message = types["tf2_msgs/msg/TFMessage"](items)
    bag = made_bags.write(tmp_path / "bag", {"/tf_static": [message]})
    np.testing.assert_allclose(
        fixed_rotation(bag, "gel", "ft").as_matrix(), turn.as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(
        fixed_rotation(bag, "ft", "gel").as_matrix(), turn.inv().as_matrix(), atol=1e-12
    )
    assert fixed_rotation(bag, "gel", "elsewhere") is None


def force_of(depth, motion, ahead_s, bias):
    """A reference sensor at 200 Hz whose clock is ahead and whose zero is off; 1 N for 0.1 mm."""
    stamps = np.arange(motion.stamp_ns[0] - 10**8, motion.stamp_ns[-1] + 10**8, 5 * 10**6)
    force = np.zeros((len(stamps), 3))
    force[:, 2] = -1e4 * np.interp(stamps, motion.stamp_ns, depth)
    return WrenchSeries("bag: /ft", stamps + round(ahead_s * 1e9), force + bias)


@pytest.mark.parametrize("ahead_s", [0.0, 0.073, -0.05])
def test_the_force_is_that_of_the_frames_by_a_clock_that_is_ahead(ahead_s):
    motion = pressed_motion(DEPTH)
    series = force_of(DEPTH, motion, ahead_s, np.zeros(3))
    force = at_frames(series, motion.stamp_ns, ahead_s)
    # Held: straight lines through readings 5 ms apart, which round off the frames of a change.
    np.testing.assert_allclose(force[14:22, 2], -2.0, atol=1e-9)
    np.testing.assert_allclose(force[8:13, 2], -1e4 * DEPTH[8:13], atol=0.03)


def test_samples_of_a_sensor_are_its_still_loads_counted_from_its_reading_at_rest():
    motion = pressed_motion(DEPTH)
    series = force_of(DEPTH, motion, 0.0, np.full(3, 3.0))
    force = zeroed(motion, at_frames(series, motion.stamp_ns, 0.0))
    (sample,) = samples_of_sensor(motion, force, SensorSampling(std=0.02))
    # The sensor's sample after the last still frame is of the release already.
    np.testing.assert_allclose(sample.force, [0, 0, -2], atol=0.01)
    np.testing.assert_allclose(sample.std, [0.02, 0.02, 0.022], atol=0.003)
    every = samples_of_sensor(motion, force, SensorSampling(steady=False))
    # Of the 8 frames of the press, the first two are within the noise.
    assert len(every) == 6 + 9
    assert len(samples_of_sensor(motion, force, SensorSampling(steady=False, most=5))) <= 5
    with pytest.raises(FrameSourceError, match="found no 12 still frames in a row"):
        samples_of_sensor(motion, force, SensorSampling(least_frames=12))


@pytest.mark.parametrize("late_s", [0.25, -0.1])
def test_a_force_that_comes_late_is_noticed_whatever_its_axes_unit_and_zero(late_s):
    motion = pressed_motion(np.concatenate([DEPTH, 2 * DEPTH, DEPTH]))
    series = force_of(np.concatenate([DEPTH, 2 * DEPTH, DEPTH]), motion, late_s, np.zeros(3))
    series = dataclasses.replace(series, force=3.0 - series.force[:, [2, 0, 1]] / 4.448)
    # Frames are 33 ms apart, and straight lines lie between them.
    assert lag_s(motion, series, 0.0) == pytest.approx(late_s, abs=0.015)
    assert lag_s(motion, series, late_s) == 0.0


def test_a_drift_of_the_zero_is_subtracted_and_what_is_no_line_is_in_the_deviation():
    depth = np.concatenate([DEPTH, np.zeros(30), DEPTH, np.zeros(30)])
    motion = pressed_motion(depth)
    series = force_of(depth, motion, 0.0, np.full(3, 3.0))
    drift = np.array([0.02, -0.05, 0.15])
    elapsed = (series.stamp_ns - motion.stamp_ns[0])[:, None] * 1e-9
    true = at_frames(series, motion.stamp_ns, 0.0) - 3.0
    drifting = dataclasses.replace(series, force=series.force + drift * elapsed)
    zero = zeroed(motion, at_frames(drifting, motion.stamp_ns, 0.0))
    np.testing.assert_allclose(zero.drift, drift, atol=0.005)
    np.testing.assert_allclose(zero.force, true, atol=0.02)
    for sample in samples_of_sensor(motion, zero, SensorSampling(std=0.01)):
        np.testing.assert_allclose(sample.force, [0, 0, -2], atol=0.02)
    bent = dataclasses.replace(series, force=series.force + 0.1 * elapsed**2)
    zero = zeroed(motion, at_frames(bent, motion.stamp_ns, 0.0))
    for sample in samples_of_sensor(motion, zero, SensorSampling(std=0.01)):
        assert (np.abs(sample.force - [0, 0, -2]) < 2 * sample.std).all()
    # Held to the end, nothing shows whether the zero drifts.
    held = pressed_motion(DEPTH[:20])
    assert np.isnan(zeroed(held, at_frames(drifting, held.stamp_ns, 0.0)).drift).all()


def test_frames_and_surfaces_of_a_bag_tell_the_same_motion(weigh_bag):
    """The simulator's own surfaces against what tracking finds in its frames."""
    sensor = load_sensor(str(weigh_bag / "sensor.yaml"))
    seen = read_motion(weigh_bag, sensor)
    true = read_motion(weigh_bag, sensor, f"/{sensor.ros_name}/truth/surface")
    assert seen.rest == range(3)
    assert true.rest == range(0)
    np.testing.assert_array_equal(seen.stamp_ns, true.stamp_ns)
    held = np.flatnonzero(read_truth(weigh_bag).wrench[:, 2] < -1.9)
    error = (seen.displacement - true.displacement)[held]
    # What tracking and triangulation reach, and noise: see the benchmark of the optics.
    assert np.nanmedian(np.abs(error)) < 5e-6
    # The two weights stand still in the frames that hold them.
    loaded = [item for item in steady_stretches(seen.displacement, 4) if item.start in held]
    assert [len(item) for item in loaded] == [5, 6]


def test_a_recording_that_cannot_serve_is_reported(weigh_bag, tmp_path):
    sensor = load_sensor("sample_rig")
    with pytest.raises(FrameSourceError, match=r"rest: found no frame from 50 to 60 s"):
        read_motion(weigh_bag, sensor, rest_s=(50, 60))
    bag = write_wrench_bag(tmp_path / "bag", [(1, 1, np.zeros(6))])
    with pytest.raises(
        FrameSourceError, match=r"found the topics /ft/wrench .*; expected images or"
    ):
        read_motion(bag, sensor)
    pattern = dataclasses.replace(sensor.pattern, rows=10)
    other = dataclasses.replace(sensor, pattern=pattern)
    with pytest.raises(FrameSourceError, match=r"no frame can be used: .*found 20, 20, "):
        read_motion(weigh_bag, other, "/sample_rig/truth/surface")
