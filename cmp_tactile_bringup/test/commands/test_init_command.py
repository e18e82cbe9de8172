"""`cmp_tactile init` writes a description that the sensor's own picture can be tracked with."""

import os
import pty
import select
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_output import run
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.sensor import parts
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.tracking.tracker import GridTracker
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import Checkerboard
from cmp_tactile_simulation.rendering.renderer import Renderer
from cmp_tactile_simulation.rendering.surface import DeformedSurface

PICTURE = Path(__file__).parents[3] / "test" / "data" / "photographs" / "wave_rest.png"


@pytest.fixture
def picture(tmp_path):
    return shutil.copy(PICTURE, tmp_path / "gel.png")


def test_a_description_is_written_with_which_the_picture_is_tracked(picture, tmp_path, capsys):
    """The next command is proposed as a shell takes it, also with a blank in the path."""
    path = tmp_path / "my rig.yaml"
    assert run("init", picture, "--pitch", "1.5", "--views", "one", "-o", path) == 0
    sensor = load_sensor(str(path))
    assert sensor.name == "my rig"
    assert sensor.pattern.pitch == pytest.approx(0.0015)
    assert "young: 500000.0  # assumed" in path.read_text()
    image = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    assert GridTracker(sensor).track(image).found_fraction == 1
    rows, cols = sensor.pattern.rows, sensor.pattern.cols
    printed = capsys.readouterr().out
    assert f"{rows} x {cols} corners" in printed
    assert f"sensor:={path}" in shlex.split(printed)


def test_a_file_that_is_there_is_kept(picture, tmp_path, capsys):
    path = tmp_path / "mine.yaml"
    path.write_text("precious")
    assert run("init", picture, "--pitch", "1.5", "-o", path) == 1
    assert path.read_text() == "precious"
    assert "another one with --output" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("nowhere.png", "found no such file"),
        ("text.png", "not a readable image"),
        ("0", "found a number, expected a camera, as /dev/video0"),
    ],
)
def test_what_is_no_picture_is_named(name, found, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.png").write_text("no picture")
    output = tmp_path / "mine.yaml"
    assert run("init", name, "--pitch", 1, "-o", output) == 1
    error = capsys.readouterr().err
    assert name in error
    assert found in error
    assert not output.exists()


def test_without_a_terminal_the_pitch_must_be_given(picture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", None)
    assert run("init", picture, "-o", tmp_path / "mine.yaml") == 2
    assert "--pitch" in capsys.readouterr().err


# Corners of the picture are found to this, px; a calibration explains their mean to this.
CORNER_TOLERANCE_PX, REPROJECTION_PX = 0.1, 0.02
# What a picture shows of a rig without distortion, as shares and m.
FOCAL_TOLERANCE, MIRROR_TOLERANCE_M, RADIUS_TOLERANCE = 0.005, 5e-5, 0.01


def frame_of(sensor):
    """A frame of a sensor at rest."""
    rendered = Renderer(sensor, Checkerboard(sensor.pattern)).render(
        DeformedSurface.rest(sensor.pattern)
    )
    return expose(rendered, CameraSettings(), np.random.default_rng(0))


@pytest.fixture(scope="module")
def sample_frame():
    """Of the sample rig."""
    return frame_of(load_sensor("sample_rig"))


def corners_of(sensor, frame):
    """Corners by view as the sensor's trackers find them, px of the frame."""
    return {
        name: GridTracker(sensor, name).track(split_frame(frame, view.placement)).corners_frame
        for name, view in build_views(sensor).items()
    }


def asked_for(path, picture, sensor, *more):
    pitch_mm = f"{sensor.pattern.pitch * 1e3:.9g}"
    return run("init", picture, "--pitch", pitch_mm, *more, "-o", path)


def other_pattern(sensor):
    """Fewer rows than columns, light corners, on a plane."""
    plane = replace(sensor.pattern.surface, type="plane", radius=np.inf)
    pattern = replace(
        sensor.pattern, rows=13, cols=16, pitch=9e-4, corner_checker="light", surface=plane
    )
    return replace(sensor, pattern=pattern)


RIGS = {
    "sample_rig": lambda: load_sensor("sample_rig"),
    "prototype": lambda: load_sensor("prototype"),
    "other pattern": lambda: other_pattern(load_sensor("prototype")),
}


@pytest.mark.parametrize("rig", RIGS)
def test_two_views_in_mirrors_are_described_as_they_are(rig, tmp_path, capsys):
    truth, path = RIGS[rig](), tmp_path / "mine.yaml"
    frame = frame_of(truth)
    cv2.imwrite(str(tmp_path / "rest.png"), frame)
    assert asked_for(path, tmp_path / "rest.png", truth, "--views", "mirrors") == 0
    found = load_sensor(str(path))
    for name, corners in corners_of(found, frame).items():
        view = build_views(truth)[name]
        expected = view.placement.to_frame(view.project(truth.pattern.corners()))
        np.testing.assert_allclose(corners, expected, atol=CORNER_TOLERANCE_PX)
    assert found.pattern.corner_checker == truth.pattern.corner_checker
    assert found.pattern.surface.type == truth.pattern.surface.type
    if np.isfinite(truth.pattern.surface.radius):
        expected = pytest.approx(truth.pattern.surface.radius, rel=RADIUS_TOLERANCE)
        assert found.pattern.surface.radius == expected
    assert found.camera.fx == pytest.approx(truth.camera.fx, rel=FOCAL_TOLERANCE)
    for name, view in truth.views.items():
        distance = found.views[name].mirror.distance
        assert distance == pytest.approx(view.mirror.distance, abs=MIRROR_TOLERANCE_M)
    rows, cols = truth.pattern.rows, truth.pattern.cols
    assert f"{rows} x {cols} corners in two mirrors" in capsys.readouterr().out


def camera_pair():
    """Two cameras that look at the gel from where the mirrors of sample_rig show it from."""
    sensor = load_sensor("sample_rig")
    views = {}
    for (name, view), left in zip(build_views(sensor).items(), (0, 512), strict=True):
        apex = view.T_view_gel[:3, 3]
        # Upright, and with the gel in the middle of the picture.
        upright = Rotation.from_euler("z", 180, degrees=True)
        inwards, _ = Rotation.align_vectors([[0, 0, 1]], upright.apply(apex)[None])
        pose = np.eye(4)
        pose[:3] = (inwards * upright).as_matrix() @ view.T_view_gel[:3]
        camera = replace(sensor.camera, cx=left + 255.5)
        views[name] = replace(sensor.views[name], mirror=None, camera=camera, T_view_gel=pose)
    optics = replace(sensor.optics, type="two_view", T_camera_gel=None)
    return replace(sensor, camera=None, optics=optics, views=views)


def test_two_cameras_are_described_as_they_are(tmp_path, capsys):
    truth, path = camera_pair(), tmp_path / "mine.yaml"
    frame = frame_of(truth)
    cv2.imwrite(str(tmp_path / "rest.png"), frame)
    assert asked_for(path, tmp_path / "rest.png", truth, "--views", "cameras") == 0
    assert "20 x 20 corners in the pictures of two cameras" in capsys.readouterr().out
    found = load_sensor(str(path))
    for name, corners in corners_of(found, frame).items():
        view = build_views(truth)[name]
        expected = view.placement.to_frame(view.project(truth.pattern.corners()))
        np.testing.assert_allclose(corners, expected, atol=CORNER_TOLERANCE_PX)
    fx = found.views["left"].camera.fx
    # Less certain than with mirrors: each camera looks at the gel from its front.
    assert fx == pytest.approx(truth.views["left"].camera.fx, rel=0.02)


# Without dots nothing shows whether a view is mirrored.  Public reports: ethz-asl/kalibr 608
# (boards flip within a recording), DeepLabCut 3239 (two views number a board apart),
# mikeferguson/robot_calibration 139 (a board turned by half looks the same).


@pytest.mark.parametrize("rig", [*RIGS, "cameras"])
def test_where_nothing_shows_a_mirror_the_views_are_asked_for(rig, tmp_path, capsys):
    truth, path = RIGS[rig]() if rig in RIGS else camera_pair(), tmp_path / "mine.yaml"
    cv2.imwrite(str(tmp_path / "rest.png"), frame_of(truth))
    assert asked_for(path, tmp_path / "rest.png", truth, "--yes") == 1
    assert "expected --views mirrors or --views cameras" in capsys.readouterr().err
    assert not path.exists()


def test_a_single_plain_view_is_asked_for(picture, tmp_path, capsys):
    path = tmp_path / "mine.yaml"
    assert run("init", picture, "--pitch", "1.5", "-o", path) == 1
    assert "expected --views one" in capsys.readouterr().err
    assert not path.exists()


def with_dots(sensor, seed=0):
    return replace(sensor, pattern=replace(sensor.pattern, code="dots", code_seed=seed))


def turned(sensor, degrees):
    """With the gel turned about its axis."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    if sensor.optics.T_camera_gel is not None:
        optics = replace(sensor.optics, T_camera_gel=sensor.optics.T_camera_gel @ pose)
        return replace(sensor, optics=optics)
    views = {
        name: replace(view, T_view_gel=view.T_view_gel @ pose)
        for name, view in sensor.views.items()
    }
    return replace(sensor, views=views)


@pytest.mark.parametrize(
    ("make", "kind", "degrees"),
    [
        (lambda: load_sensor("sample_rig"), "mirror_stereo", 0),
        (lambda: load_sensor("sample_rig"), "mirror_stereo", 180),
        (camera_pair, "two_view", 0),
        (camera_pair, "two_view", 90),
    ],
    ids=["mirrors", "mirrors, turned by half", "cameras", "cameras, turned by a quarter"],
)
def test_dots_show_what_views_are_and_how_the_print_is_turned(
    make, kind, degrees, tmp_path, capsys
):
    truth, path = turned(with_dots(make()), degrees), tmp_path / "mine.yaml"
    frame = frame_of(truth)
    cv2.imwrite(str(tmp_path / "rest.png"), frame)
    assert asked_for(path, tmp_path / "rest.png", truth) == 0
    assert "with dots (seed 0)" in capsys.readouterr().out
    found = load_sensor(str(path))
    assert found.optics.type == kind
    assert (found.pattern.code, found.pattern.border) == ("dots", "in_view")
    for name, corners in corners_of(found, frame).items():
        view = build_views(truth)[name]
        expected = view.placement.to_frame(view.project(truth.pattern.corners()))
        np.testing.assert_allclose(corners, expected, atol=CORNER_TOLERANCE_PX)


FOCAL_PX, SIDE_PX, PITCH_M = 600.0, 18.0, 1e-3


def one_camera(rows, cols, border):
    """Looks straight at a print with dots, which is as large as the gel if it goes on."""
    pose = np.eye(4)
    pose[2, 3] = FOCAL_PX * PITCH_M / SIDE_PX
    pattern = parts.Pattern(
        rows, cols, PITCH_M, "dark", 6, parts.PatternSurface(), code="dots", border=border
    )
    return replace(
        load_sensor("sample_rig"),
        image=parts.ImageSize(640, 480),
        camera=parts.Camera("pinhole", FOCAL_PX, FOCAL_PX, 319.5, 239.5, (0.0,) * 5),
        optics=parts.Optics("monocular", pose, ()),
        views={"left": parts.ViewDescription(parts.Roi(0, 0, 640, 480))},
        pattern=pattern,
        elastomer=parts.Elastomer(
            (0.07, 0.07, 0.005), 5e5, 0.48, "linear", parts.ShadingLayer(3e-4, 5e5)
        ),
    )


def photograph(sensor):
    sheet = sensor.pattern.sheet(sensor.elastomer.size[:2])
    rendered = Renderer(sensor, Checkerboard(sheet)).render(DeformedSurface.rest(sheet))
    return expose(rendered, CameraSettings(), np.random.default_rng(0))


@pytest.mark.parametrize("shift", [(0, 0), (60, -40)], ids=["in the middle", "aside"])
def test_the_middle_of_a_sheet_that_goes_on_is_described(shift, tmp_path):
    truth, path = one_camera(20, 24, "beyond_view"), tmp_path / "mine.yaml"
    frame = np.roll(photograph(truth), shift, (1, 0))
    cv2.imwrite(str(tmp_path / "rest.png"), frame)
    assert asked_for(path, tmp_path / "rest.png", truth) == 0
    found = load_sensor(str(path))
    assert (found.pattern.code, found.pattern.border) == ("dots", "beyond_view")
    corners = GridTracker(found).track(frame).corners
    rows, cols = (found.pattern.rows - 20) // 2, (found.pattern.cols - 24) // 2
    expected = build_views(truth)["left"].project(truth.pattern.corners()) + shift
    seen = expected[max(-rows, 0) :, max(-cols, 0) :]
    np.testing.assert_allclose(
        corners[max(rows, 0) :, max(cols, 0) :][:10, :10], seen[:10, :10], atol=CORNER_TOLERANCE_PX
    )


def test_a_part_of_a_sheet_is_described_without_its_dots(tmp_path, capsys):
    truth, path = one_camera(18, 20, "in_view"), tmp_path / "mine.yaml"
    cv2.imwrite(str(tmp_path / "rest.png"), photograph(truth)[:, :490])
    assert asked_for(path, tmp_path / "rest.png", truth) == 0
    assert "show the whole pattern" in capsys.readouterr().out
    assert load_sensor(str(path)).pattern.code == "none"


def test_dots_contradict_wrong_views(tmp_path, capsys):
    truth, path = with_dots(load_sensor("sample_rig")), tmp_path / "mine.yaml"
    cv2.imwrite(str(tmp_path / "rest.png"), frame_of(truth))
    assert asked_for(path, tmp_path / "rest.png", truth, "--views", "cameras") == 1
    assert "mirrored, expected those of --views cameras" in capsys.readouterr().err
    assert not path.exists()
    # In one view without a mirror, too, and where the views differ.
    frame = frame_of(truth)
    for shown, views in (
        (frame[:, :512], "one"),
        (np.hstack([frame[:, :512], frame[:, 511::-1]]), ""),
    ):
        cv2.imwrite(str(tmp_path / "rest.png"), shown)
        assert asked_for(path, tmp_path / "rest.png", truth) == 1
        assert f"expected those of --views {views}" in capsys.readouterr().err


def test_dots_of_another_sheet_are_named(tmp_path, capsys):
    truth, path = with_dots(load_sensor("sample_rig"), 3), tmp_path / "mine.yaml"
    picture = tmp_path / "rest.png"
    cv2.imwrite(str(picture), frame_of(truth))
    assert asked_for(path, picture, truth, "--views", "mirrors") == 0
    assert "not those of seed 0: give --code-seed" in capsys.readouterr().out
    other = tmp_path / "other.yaml"
    assert asked_for(other, picture, truth, "--code-seed", "3") == 0
    assert load_sensor(str(other)).pattern.code_seed == 3


def test_views_that_the_given_kind_does_not_show_are_refused(sample_frame, tmp_path, capsys):
    truth, path = load_sensor("sample_rig"), tmp_path / "mine.yaml"
    cv2.imwrite(str(tmp_path / "rest.png"), sample_frame)
    assert asked_for(path, tmp_path / "rest.png", truth, "--views", "cameras") == 1
    assert "expected another --views" in capsys.readouterr().err
    assert not path.exists()


def test_one_of_two_views_in_sight_is_named_where_two_are_asked_for(sample_frame, tmp_path, capsys):
    truth = load_sensor("sample_rig")
    frame = sample_frame.copy()
    frame[:, 512:] = np.random.default_rng(1).normal(90, 3, (768, 512)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "rest.png"), frame)
    path = tmp_path / "mine.yaml"
    assert asked_for(path, tmp_path / "rest.png", truth, "--views", "mirrors") == 1
    assert "error: right view: found" in capsys.readouterr().err
    assert not path.exists()
    assert asked_for(path, tmp_path / "rest.png", truth, "--views", "one") == 0
    assert load_sensor(str(path)).optics.type == "monocular"
    assert "20 x 20 corners, and the pattern ends" in capsys.readouterr().out


def test_unequal_patterns_in_the_two_views_are_refused(sample_frame, tmp_path, capsys):
    truth = load_sensor("sample_rig")
    smaller = replace(truth, pattern=replace(truth.pattern, rows=17))
    frame, other = sample_frame.copy(), frame_of(smaller)
    frame[:, 512:] = other[:, 512:]
    cv2.imwrite(str(tmp_path / "rest.png"), frame)
    path = tmp_path / "mine.yaml"
    assert asked_for(path, tmp_path / "rest.png", truth) == 1
    error = capsys.readouterr().err
    assert "found 20 x 20 corners in the left view and 17 x 20 corners in the right view" in error
    assert not path.exists()


def answered(words, answers):
    """Output and exit code of the command on a terminal, where questions get these answers."""
    terminal, theirs = pty.openpty()
    program = "import sys; from cmp_tactile_bringup.command import main; sys.exit(main())"
    process = subprocess.Popen(
        [sys.executable, "-c", program, *words], stdin=theirs, stdout=theirs, stderr=theirs
    )
    os.close(theirs)
    shown, left = "", list(answers)
    while select.select([terminal], [], [], 300)[0]:
        try:
            shown += os.read(terminal, 4096).decode()
        except OSError:  # the program has ended
            break
        if left and shown.endswith("]: "):
            os.write(terminal, f"{left.pop(0)}\n".encode())
    os.close(terminal)
    return shown, process.wait(60)


def test_on_a_terminal_what_is_missing_is_asked_for(sample_frame, tmp_path):
    path = tmp_path / "mine.yaml"
    cv2.imwrite(str(tmp_path / "rest.png"), sample_frame)
    answers = [tmp_path / "rest.png", "soft", "0.7", "", "mirrors", "300", ""]
    shown, code = answered(["init", "-o", str(path)], answers)
    assert code == 0, shown
    assert "found 'soft', expected a number from 0.01 to 50 mm" in shown
    found = load_sensor(str(path))
    assert found.pattern.pitch == pytest.approx(7e-4)
    assert "expected one of mirrors, cameras" in shown
    assert found.optics.type == "mirror_stereo"
    assert found.elastomer.young == pytest.approx(3e5)
    assert "young: 300000.0\n" in path.read_text()
    assert "size:" in path.read_text().split("# x, y, thickness at the apex, assumed")[0]


def test_nothing_is_asked_for_where_that_is_said(tmp_path, monkeypatch, capsys):
    picture, path = shutil.copy(PICTURE, tmp_path / "gel.png"), tmp_path / "mine.yaml"
    terminal, theirs = pty.openpty()
    # The end of the input, for whoever asks.
    os.write(terminal, b"\x04" * 10)
    with os.fdopen(theirs) as stdin:
        assert stdin.isatty()
        monkeypatch.setattr("sys.stdin", stdin)
        assert run("init", picture, "--pitch", "1.5", "--views", "one", "--yes", "-o", path) == 0
        assert path.exists()
        assert run("init", picture, "--yes", "-o", tmp_path / "b.yaml") == 2
    os.close(terminal)
    assert "--pitch: found nothing" in capsys.readouterr().err
