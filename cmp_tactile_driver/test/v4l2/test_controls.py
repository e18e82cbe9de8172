"""Controls of a camera by linuxpy, on a device that answers as the kernel does (fake_v4l2)."""

import errno

import pytest
from linuxpy.video import device as v4l2
from linuxpy.video import raw

from cmp_tactile_driver.v4l2.controls import CameraControls, ControlKind
from cmp_tactile_processing.errors import FrameSourceError


@pytest.fixture
def camera(plug):
    return plug()


@pytest.fixture
def controls(camera):
    with v4l2.Device(camera.node) as device:
        yield CameraControls(device)


def test_every_control_is_described_as_the_camera_does(controls):
    found = {item.name: item for item in controls.by_name.values()}
    kinds = {name: item.kind.value for name, item in found.items()}
    assert kinds == {
        "brightness": "integer",
        "white_balance_automatic": "boolean",
        "gain": "integer",
        "power_line_frequency": "menu",
        "white_balance_temperature": "integer",
        "firmware": "text",
        "calibrate_sensor": "button",
        "link_frequency": "menu",
        "auto_exposure": "menu",
        "exposure_time_absolute": "integer",
    }
    temperature = found["white_balance_temperature"]
    assert (temperature.low, temperature.high, temperature.step) == (2800, 6500, 10)
    assert temperature.title == "White Balance Temperature"
    menu = ((0, "Auto Mode"), (1, "Manual Mode"), (3, "Aperture Priority Mode"))
    assert found["auto_exposure"].choices == menu
    assert found["link_frequency"].choices == ((0, "400"), (1, "800"))
    assert found["firmware"].fixed
    assert controls.skipped == ("Gamma Table",)
    values = controls.values()
    assert (values["gain"], values["white_balance_automatic"]) == (20, True)
    assert (values["firmware"], values["calibrate_sensor"]) == ("1.07", False)


def test_automatic_controls_are_set_before_those_that_they_rule(camera, controls):
    controls.set({"exposure_time_absolute": 40, "auto_exposure": 1})
    assert camera.named("Exposure Time, Absolute").value == 40
    assert camera.named("Auto Exposure").value == 1


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        (
            "exposure_time_absolute",
            40,
            r"exposure_time_absolute: .*without effect while auto_exposure is 3 \(Aperture Prior",
        ),
        ("white_balance_temperature", 4000, "without effect while white_balance_automatic is True"),
        ("firmware", "2", "firmware: found a read-only control"),
        ("auto_exposure", 2, "found 2, expected one of 0: Auto Mode, 1: Manual Mode, 3: Aperture"),
    ],
)
def test_what_cannot_be_set_is_refused_with_the_reason(controls, name, value, reason):
    with pytest.raises(FrameSourceError, match=reason):
        controls.set({name: value})


def test_all_are_set_or_none(camera, controls):
    with pytest.raises(FrameSourceError, match="firmware"):
        controls.set({"gain": 55, "auto_exposure": 1, "firmware": "2"})
    assert (camera.named("Gain").value, camera.named("Auto Exposure").value) == (20, 3)


def test_a_button_is_pushed_by_true(camera, controls):
    controls.set({"calibrate_sensor": False})
    assert camera.pushed == 0
    controls.set({"calibrate_sensor": True})
    assert camera.pushed == 1
    assert controls.by_name["calibrate_sensor"].kind is ControlKind.BUTTON


def test_restore_sets_what_can_be_set(camera, controls):
    wanted = {**controls.values(), "auto_exposure": 1, "exposure_time_absolute": 9, "gain": 3}
    assert controls.restore({**wanted, "gone": 1}) == []
    values = {item.name: item.value for item in camera.controls}
    assert (values["Exposure Time, Absolute"], values["Gain"]) == (9, 3)
    assert camera.pushed == 0
    camera.fault[raw.IOC.S_EXT_CTRLS] = errno.EIO
    failures = controls.restore({"gain": 5, "brightness": 8})
    assert len(failures) == 1
    assert "gain: set to 5" in failures[0]
