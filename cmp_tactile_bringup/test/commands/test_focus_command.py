"""`cmp_tactile focus` shows what frames are worth: known blur, noise and contrast are measured."""

import re
import threading

import cv2
import numpy as np
import pytest
from command_output import run
from fake_v4l2 import FakeCamera, FakeKernel
from waiting import wait_until

from cmp_tactile_bringup import terminal
from cmp_tactile_bringup.commands import camera as camera_commands
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import Checkerboard
from cmp_tactile_simulation.rendering.renderer import Renderer
from cmp_tactile_simulation.rendering.surface import DeformedSurface

PITCH = ["--pitch", "0.6905"]
# Shown to two digits; a lens that blurs before the pixels do is measured to this, px.
BLUR_TOLERANCE_PX, NOISE_TOLERANCE, CONTRAST_TOLERANCE = 0.08, 0.15, 0.05


@pytest.fixture(scope="module")
def rendered():
    sensor = load_sensor("sample_rig")
    return Renderer(sensor, Checkerboard(sensor.pattern)).render(
        DeformedSurface.rest(sensor.pattern)
    )


@pytest.fixture(autouse=True)
def _every_frame(monkeypatch, own_signals):
    """A line for each frame, however quick."""
    monkeypatch.setattr(camera_commands, "LINE_S", 0.0)


def taken(rendered, **settings):
    light = {"vignette": 0.0, **settings}
    return expose(rendered, CameraSettings(**light), np.random.default_rng(3))


def figures(text, name):
    """The numbers behind a word, once for each view."""
    return [float(found) for found in re.findall(rf"{name} ([\d.]+)", text)]


@pytest.mark.parametrize(
    ("blur", "noise", "dark"),
    [(0.7, 1.0, 45.0), (1.8, 1.0, 45.0), (0.7, 5.0, 45.0), (1.0, 2.0, 125.0)],
)
def test_blur_noise_and_contrast_of_both_views_are_shown(  # noqa: PLR0917
    rendered, blur, noise, dark, tmp_path, capsys
):
    image = taken(rendered, blur=blur, read_noise=noise, dark_level=dark)
    cv2.imwrite(str(tmp_path / "rest.png"), image)
    assert run("focus", tmp_path / "rest.png", *PITCH) == 0
    shown = capsys.readouterr().out
    assert shown.count("\n") == 1
    for name, truth, tolerance in (
        ("blur", blur, BLUR_TOLERANCE_PX),
        ("noise", noise, NOISE_TOLERANCE * noise),
        ("contrast", 205 - dark, CONTRAST_TOLERANCE * (205 - dark)),
    ):
        found = figures(shown, name)
        assert len(found) == 2
        assert found == pytest.approx([truth] * 2, abs=tolerance + 0.05)


def test_the_best_blur_so_far_stays_while_the_focus_turns(rendered, tmp_path, capsys):
    for number, blur in enumerate((2.0, 0.8, 1.8)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), taken(rendered, blur=blur))
    assert run("focus", tmp_path, *PITCH, "--views", "mirrors") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [figures(line, "best")[0] for line in lines] == pytest.approx(
        [2.0, 0.8, 0.8], abs=BLUR_TOLERANCE_PX
    )
    assert ["adjust the focus" in line for line in lines] == [True, False, True]


def test_frames_without_checkers_are_said_to_be_so_and_more_follow(rendered, tmp_path, capsys):
    good = taken(rendered)
    dark = np.zeros_like(good)
    grey = np.random.default_rng(1).normal(120, 3, good.shape).astype(np.uint8)
    bright = np.full_like(good, 255)
    for number, image in enumerate((dark, grey, bright, good)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image)
    assert run("focus", tmp_path, *PITCH) == 0
    lines = capsys.readouterr().out.splitlines()
    reasons = ("too dark", "no contrast", "too bright", "left: px per checker")
    assert len(lines) == len(reasons)
    assert all(reason in line for line, reason in zip(lines, reasons, strict=True))


def test_a_scene_is_shown_until_a_signal_comes(capsys, monkeypatch):
    stops = iter((False, False, True))

    class Stop:
        def wait(self, _timeout):
            return next(stops)

    monkeypatch.setattr("cmp_tactile_processing.processes.StopSignal", Stop)
    assert run("focus", "grasp", *PITCH) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_an_unplugged_camera_is_named(rendered, tmp_path, monkeypatch, capsys):
    machine = FakeKernel(tmp_path / "machine")
    machine.install(monkeypatch)
    camera = FakeCamera(modes={"GREY": {(1024, 768): (30,)}})
    node = machine.plug(camera)
    monkeypatch.setattr(camera_commands, "DEVICES", f"{node.parent}/")
    pixels = taken(rendered).tobytes()

    def feed():
        wait_until(lambda: camera.streaming, "the stream")
        camera.give(pixels)

    def print_and_unplug(_console, text):
        print(text)
        machine.unplug(camera)

    monkeypatch.setattr(terminal, "print_line", print_and_unplug)
    feeder = threading.Thread(target=feed)
    feeder.start()
    assert run("focus", node, *PITCH, "--size", "1024x768") == 1
    feeder.join()
    printed = capsys.readouterr()
    assert "left: px per checker" in printed.out
    assert f"error: {node}" in printed.err
    assert "found it unplugged, expected a camera" in printed.err
