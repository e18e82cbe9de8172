"""`cmp_tactile process`: files that it writes, errors in one line, exit codes."""

import csv
import re
import shutil
from functools import partial

import cv2
import made_bags
import numpy as np
import pytest
from command_output import one_line_error, output_of, printed, run
from ros_graph import stamps_of
from rosbags.highlevel import AnyReader

from cmp_tactile_bringup.offline import processor
from cmp_tactile_bringup.offline.jobs import Options, plan_jobs
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing.force.advice import RECORDED_ADVICE
from cmp_tactile_processing.measured import ForceFlag
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import find_sensor_description, load_sensor

MS = 10**6
# Arrays are written as float32: half a unit in the last place of 1000 px.
ATOL_PX = 1e-4
ATOL_M = 1e-9


process = partial(run, "process", "--sensor", "sample_rig")


def test_process_writes_what_the_pipeline_gives(images, tmp_path):
    assert process(images, "--output", tmp_path / "out", "--frame-rate", 50, "--arrays") == 0
    pipeline = Pipeline(load_sensor("sample_rig"))
    with np.load(tmp_path / "out" / "images.npz", allow_pickle=False) as arrays:
        assert arrays["stamp_ns"].tolist() == [0, 20_000_000, 40_000_000]
        for k in range(3):
            result = pipeline.process(cv2.imread(str(images / f"{k}.png"), cv2.IMREAD_GRAYSCALE))
            np.testing.assert_allclose(arrays["left_corners"][k], result.left.corners, atol=ATOL_PX)
            np.testing.assert_array_equal(
                arrays["right_col_line_status"][k], result.right.col_line_status
            )
            np.testing.assert_allclose(arrays["position"][k], result.surface.position, atol=ATOL_M)
            force = result.force
            np.testing.assert_allclose(arrays["wrench"][k], force.wrench, rtol=1e-5)
            np.testing.assert_allclose(
                arrays["wrench_covariance"][k], force.wrench_covariance, rtol=1e-5
            )
            assert arrays["flags"][k] == force.flags
            assert arrays["contact_number"][k].max() == len(force.contacts)
    with (tmp_path / "out" / "images_wrench.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert float(rows[2]["fz_N"]) == pytest.approx(result.force.wrench[2])
    assert float(rows[2]["my_Nm"]) == pytest.approx(force.wrench[4])
    assert float(rows[2]["std_fz_N"]) == pytest.approx(force.wrench_std[2], nan_ok=True)
    assert int(rows[2]["slip_state"]) == force.slip_state
    assert int(rows[2]["contacts"]) == len(force.contacts)
    assert int(rows[2]["flags"]) == force.flags
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "images.mcap",
        "images.npz",
        "images.yaml",
        "images_wrench.csv",
    ]


def messages(path, topic):
    """Messages of a topic of the sample rig, read as anybody would who knows nothing of us."""
    with AnyReader([path]) as reader:
        chosen = [item for item in reader.connections if item.topic == f"/sample_rig/{topic}"]
        return [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(chosen)]


def stamps(path, topic):
    return stamps_of(messages(path, topic))


def test_process_of_a_damaged_folder_keeps_the_good_frames_and_says_so(images, tmp_path, capsys):
    (images / "1.png").write_bytes((images / "1.png").read_bytes()[:1000])
    assert process(images, "--output", tmp_path) == 1
    assert len(stamps(tmp_path / "images.mcap", "wrench")) == 2
    assert "1.png" in capsys.readouterr().err
    (images / "2.png").write_bytes(b"")
    assert process(images, "--output", tmp_path, "--overwrite") == 1
    assert "2 bad frames, last: " in printed(capsys)


def test_process_reports_in_how_many_frames_a_view_shows_no_pattern(images, tmp_path, capsys):
    frame = cv2.imread(str(images / "1.png"), cv2.IMREAD_GRAYSCALE)
    frame[:, :512] = 0
    cv2.imwrite(str(images / "1.png"), frame)
    assert process(images, "--output", tmp_path, "--arrays") == 0
    said = printed(capsys)
    assert "warning" in said
    assert "left view: in 1 of 3 frames dark: too dark" in said
    assert "right view" not in said
    with np.load(tmp_path / "images.npz", allow_pickle=False) as arrays:
        assert arrays["left_fault"].tolist() == ["", "dark", ""]
        assert arrays["right_fault"].tolist() == ["", "", ""]
        assert np.isnan(arrays["left_corners"][1]).all()
        assert (arrays["right_corner_std"][1] < 0.5).all()


def test_frames_that_all_have_a_fault_are_a_failure_that_says_how_many(images, tmp_path, capsys):
    for path in images.iterdir():
        cv2.imwrite(str(path), np.zeros((768, 1024), np.uint8))
    assert process(images, "--output", tmp_path) == 1
    said = printed(capsys)
    assert f"error: {images}: all 3 frames have a fault" in said
    assert f"warning: {images}: left view: in 3 of 3 frames dark" in said


@pytest.fixture
def bag_with_stamps(images, tmp_path):
    """Writes a bag of one of the images, once for each stamp, ns."""
    image = cv2.imread(str(images / "0.png"), cv2.IMREAD_GRAYSCALE)

    def write(stamps_ns):
        shown = [made_bags.image(image, stamp_ns) for stamp_ns in stamps_ns]
        return made_bags.write(tmp_path / "in" / "bag", {"/rig/image_raw": shown})

    return write


def test_stamps_out_of_order_are_reported_as_by_the_nodes_and_stand_in_the_table(
    bag_with_stamps, tmp_path, capsys
):
    year = 365 * 86400 * 10**9
    begin_ns = made_bags.FIRST_STAMP_NS
    back_ns = begin_ns - 5000 * MS
    later = [begin_ns, begin_ns + 50 * MS, begin_ns + 50 * MS, begin_ns + 100 * MS, back_ns, 0]
    # A clock that is set, and a gap.
    later += [begin_ns + year, begin_ns + year + 10_000 * MS]
    assert process(bag_with_stamps(later), "--output", tmp_path) == 0
    said = printed(capsys)
    # Back and forth.
    assert "skipped jumps of the stamps: 2, the largest 3.1536e+07 s at" in said
    assert "1 of 8 stamps came twice" in said
    assert "1 of 8 stamps were 0" in said
    assert "missing in gaps between stamps; the longest gap is 10 s" in said
    with (tmp_path / "bag_wrench.csv").open() as table:
        faults = [row["stamp_fault"].split() for row in csv.DictReader(table)]
    # The picture is always the same.
    assert [fault[-1:] for fault in faults] == [[]] + 7 * [["old_picture"]]
    assert [" ".join(fault[:-1]) for fault in faults] == [
        "",
        "",
        "repeated",
        "",
        "back",
        "zero",
        "",
        "gap",
    ]


def test_a_repeated_picture_is_reported_and_its_force_not_usable(images, tmp_path, capsys):
    """A camera that stops while the gel is pressed goes on to show it at rest."""
    for k in (1, 2):
        shutil.copy(images / "0.png", images / f"{k}.png")
    frame = cv2.imread(str(images / "0.png"), cv2.IMREAD_GRAYSCALE)
    frame[0, 0] ^= 1
    cv2.imwrite(str(images / "3.png"), frame)
    assert process(images, "--output", tmp_path) == 0
    assert "in 2 of 4 frames the picture is that of the frame before" in printed(capsys)
    with (tmp_path / "images_wrench.csv").open() as table:
        rows = [(row["stamp_fault"], row["usable"]) for row in csv.DictReader(table)]
    assert rows == [("", "1"), ("old_picture", "0"), ("old_picture", "0"), ("", "1")]


def test_light_that_flickers_is_reported(images, tmp_path, capsys):
    for k in range(3):
        frame = cv2.imread(str(images / f"{k}.png"), cv2.IMREAD_GRAYSCALE)
        frame[200 * k : 200 * k + 150] //= 2
        cv2.imwrite(str(images / f"{k}.png"), frame)
    assert process(images, "--output", tmp_path) == 0
    assert "the light flickers" in printed(capsys)


def test_pictures_of_two_cameras_are_processed_as_one_frame(images, tmp_path, capsys):
    rows = []
    for late_ms, (name, view) in zip((0, 12), load_sensor("sample_rig").views.items(), strict=True):
        (tmp_path / "apart" / f"{name}_camera").mkdir(parents=True)
        roi = view.roi
        for path, stamp_ns in zip(sorted(images.iterdir()), made_bags.stamps(3), strict=True):
            frame = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            part = frame[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width]
            cv2.imwrite(str(tmp_path / "apart" / f"{name}_camera" / path.name), part)
            at = stamp_ns + late_ms * MS
            rows.append((f"/{name}_camera/image", at, made_bags.image(part, at)))
    given = ("--topic", "left_camera,right_camera", "--output", tmp_path)
    assert process(tmp_path / "apart", *given) == 0
    assert process(images, "--output", tmp_path) == 0
    tables = [(tmp_path / f"{name}_wrench.csv").read_text() for name in ("apart", "images")]
    assert tables[0] == tables[1]
    bag = made_bags.write_rows(tmp_path / "bag", rows)
    topics = "/left_camera/image,/right_camera/image"
    capsys.readouterr()
    assert process(bag, "--topic", topics, "--output", tmp_path / "out") == 0
    assert "left and right pictures are up to 12.0 ms apart" in printed(capsys)


def test_a_recording_that_goes_back_in_time_is_processed_as_a_new_one_from_there(
    grasp_bag, tmp_path
):
    """Corners that are followed from frame to frame differ a little from those detected."""
    frames = [frame.image for frame in BagReader(grasp_bag).frames()]
    earlier_ns = made_bags.FIRST_STAMP_NS - 5000 * MS
    stamped = [(frames[5], earlier_ns + 5000 * MS), (frames[6], earlier_ns)]
    results = []
    for name, shown in (("back", stamped), ("fresh", stamped[1:])):
        bag = made_bags.write(
            tmp_path / "in" / name, {"/rig/image_raw": [made_bags.image(*frame) for frame in shown]}
        )
        assert process(bag, "--output", tmp_path, "--arrays") == 0
        with np.load(tmp_path / f"{name}.npz") as arrays:
            results.append({key: arrays[key][-1] for key in ("wrench", "left_corners", "position")})
    for key, wanted in results[1].items():
        np.testing.assert_array_equal(results[0][key], wanted, err_msg=key)


def test_an_unusable_input_does_not_keep_the_others_from_being_processed(images, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    other = tmp_path / "[red]other"
    other.mkdir()
    shutil.copy(images / "0.png", other)
    sources = (images / "1.png", tmp_path / "empty", tmp_path / "absent", other)
    assert process(*sources, "--output", tmp_path / "out") == 1
    err = capsys.readouterr().err
    errors = [line for line in err.splitlines() if line.startswith("error:")]
    assert len(errors) == 2
    # What is not there is reported before anything is processed.
    errors.reverse()
    assert "empty: found nothing" in errors[0]
    assert "absent: found no such file or folder, expected a ROS 2 bag, a folder of" in errors[1]
    assert "or the name of a scene: " in errors[1]
    for name in ("1", "[red]other"):
        assert f"1 frames -> {tmp_path / 'out' / name}.mcap" in err
        assert (tmp_path / "out" / f"{name}_wrench.csv").is_file()


@pytest.mark.usefixtures("short_scenes", "grasp_bag")
def test_a_packaged_scene_is_processed_with_its_own_sensor(tmp_path, capsys):
    assert run("process", "grasp", "--output", tmp_path) == 0
    err = capsys.readouterr().err
    assert "warning" not in err
    assert f"sensor description: {find_sensor_description('sample_rig')}" in err
    assert len(stamps(tmp_path / "grasp.mcap", "force_field")) == 20


@pytest.mark.usefixtures("short_scenes", "grasp_bag")
def test_a_wrong_sensor_is_found_by_camera_info_and_by_rays(tmp_path, wrong_sensor, capsys):
    """Everything else about the results looks as it should."""
    given = ("--sensor", wrong_sensor, "--output", tmp_path / "out")
    assert run("process", "grasp", *given) == 0
    err = capsys.readouterr().err
    warnings = [line for line in err.splitlines() if line.startswith("warning: grasp: ")]
    assert len(warnings) >= 3
    assert "/sample_rig/camera_info: K: found [733.386, 0, 511.5, 0, 733.386, 3" in warnings[0]
    assert "in 20 frames: the left and right rays" in warnings[1]
    assert all(line.endswith("the description of this sensor?") for line in warnings[:2])
    # Rays that miss each other make surfaces that no force explains.
    (poor_fit,) = (line for line in warnings if " of 20 frames poor_fit" in line)
    assert poor_fit.endswith(RECORDED_ADVICE[ForceFlag.POOR_FIT])


@pytest.mark.usefixtures("short_scenes")
def test_a_video_that_encodes_changes_has_wider_error_bars(tmp_path, grasp_bag, capsys):
    """Its forces against those of the same frames without loss."""
    frames = [cv2.cvtColor(f.image, cv2.COLOR_GRAY2BGR) for f in BagReader(grasp_bag).frames()]
    video = made_bags.write_video(tmp_path / "grasp.mp4", "mp4v", frames)
    tables = []
    for source in (video, grasp_bag):
        out = tmp_path / f"of_{len(tables)}"
        given = ("--sensor", "sample_rig", "--output", out, "--reference", "first-3")
        assert run("process", source, *given) == 0
        (path,) = out.glob("*_wrench.csv")
        with path.open() as table:
            tables.append(list(csv.DictReader(table)))
    assert capsys.readouterr().err.count("encoded as fmp4") == 1
    assert len(tables[0]) == len(tables[1]) == len(frames)
    for row, known in zip(*tables, strict=True):
        for axis in ("fx_N", "fy_N", "fz_N"):
            # Errors of the description are the same in both.
            random = float(row[f"std_{axis}"]) ** 2 - float(row[f"systematic_{axis}"]) ** 2
            assert abs(float(row[axis]) - float(known[axis])) <= 4 * np.sqrt(random)


INVERSE_POSE = """  T_camera_gel:
    - [1.0, 0.0, 0.0, 0.0]
    - [0.0, -0.7179596728076926, 0.6960846990286967, -0.004929257]
    - [0.0, -0.6960846990286967, -0.7179596728076926, -0.015141602]
"""


@pytest.mark.parametrize(
    ("pattern", "change", "expected"),
    [
        ("0.0006904761904761905", "0.00034523809523809525", "check pattern.pitch"),
        ("0.0006904761904761905", "0.001380952380952381", "check pattern.pitch"),
        (r"  T_camera_gel:\n(    - .*\n){3}", INVERSE_POSE, "not inside the view"),
    ],
    ids=["half the pitch", "twice the pitch", "inverse pose"],
)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_description_by_which_nothing_is_found_is_named(
    images, tmp_path, capsys, request, *, pattern, change, expected
):
    text = find_sensor_description("sample_rig").read_text()
    if "twice" in request.node.name:
        text = text.replace("size: [0.022, 0.022, 0.006]", "size: [0.027, 0.027, 0.012]")
    changed, count = re.subn(pattern, change, text, count=1)
    assert count == 1
    path = tmp_path / "wrong.yaml"
    path.write_text(changed)
    assert run("process", images, "--sensor", path, "--output", tmp_path / "out") == 1
    said = printed(capsys)
    assert expected in said
    assert "with checkers of" in said
    assert "RuntimeWarning" not in said


@pytest.fixture
def wrong_sensor(tmp_path):
    """The sample rig with another principal point, and its left mirror 0.2 mm elsewhere."""
    text = find_sensor_description("sample_rig").read_text()
    path = tmp_path / "wrong.yaml"
    changed = text.replace("cy: 383.5", "cy: 384.5").replace("-0.0098254", "-0.0096254", 1)
    path.write_text(changed)
    assert "cy: 384.5" in changed
    assert changed.count("-0.0098254") == 1
    return path


def test_results_never_lie_in_the_place_of_the_recording(images, tmp_path, capsys):
    """A bag's file has the name that its results would have, and --overwrite is soon said."""
    bag = tmp_path / "bag.mcap"
    bag.write_bytes(b"precious")
    assert process(bag, "--output", tmp_path, "--overwrite") == 1
    one_line_error(capsys, "bag.mcap: found --output", "outside the recording")
    assert bag.read_bytes() == b"precious"
    assert process(images, "--output", images) == 1
    one_line_error(capsys, "images: found --output", "outside the recording")


def test_a_recording_of_another_size_is_refused_before_any_work(tmp_path, capsys, monkeypatch):
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.zeros((48, 64), np.uint8))
    monkeypatch.setattr(processor, "compile_elsewhere", lambda *_: pytest.fail("compiles"))
    assert process(tmp_path, "--output", tmp_path / "out") == 1
    one_line_error(capsys, "first 2 of 3 images", "64 x 48", "1024 x 768")
    assert not list(tmp_path.glob("out/*"))


def test_one_recording_is_processed_once_and_two_of_one_name_not_at_all(images, tmp_path, capsys):
    image = images / "1.png"
    twice = (image, images / "0.png", images / ".." / images.name / "1.png")
    assert process(*twice, "--output", tmp_path / "out") == 0
    said = printed(capsys)
    assert "recordings that are named twice" in said
    assert "2 recordings, 2 without problems" in said
    other = tmp_path / "other"
    other.mkdir()
    shutil.copy(image, other)
    assert process(image, other / "1.png", "--output", tmp_path / "two") == 1
    said = printed(capsys)
    assert f"1.png: found the same name as {image}, expected different names, or" in said
    assert not (tmp_path / "two").exists()


# What processing a real recording loads.
CODE = """
import sys
from pathlib import Path

import cmp_tactile_bringup.offline.processor
from cmp_tactile_bringup.recordings.library import check_source, required_sensor

source = Path(sys.argv[1])
check_source(source)
required_sensor(source, "sample_rig")
print([name for name in sys.modules if name.startswith("cmp_tactile_simulation")])
"""


def test_processing_a_recording_loads_nothing_of_the_simulator(images):
    assert output_of("-c", CODE, images) == "[]\n"


def test_numbers_after_a_point_are_no_suffix(tmp_path):
    """Results have the name that the user gave, without the suffix of a file.

    Public reports, tried here (report: trial: result):
    - equinor/xtgeo 592: several points in a name: only the known suffix is cut
    - beetbox/beets 5774: a folder's name is cut at its point: kept whole
    """
    folders = [tmp_path / name for name in ("press_0.5N", "press_0.7N", "run.mcap.d")]
    for folder in folders:
        folder.mkdir()
    files = [tmp_path / name for name in ("a_0.5N.mcap", "b.v2.PNG", "c_0.1.mp4", "d_0.5N")]
    for file in files:
        file.touch()
    names = [job.name for job in plan_jobs([*folders, *files], tmp_path / "out", Options())]
    assert names == [*(folder.name for folder in folders), "a_0.5N", "b.v2", "c_0.1", "d_0.5N"]
