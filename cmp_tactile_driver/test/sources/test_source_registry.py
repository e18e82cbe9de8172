"""Sources are found through entry points: the driver's own, and those of other packages."""

import sys

import cv2
import made_bags
import numpy as np
import pytest

from cmp_tactile_driver.sources.frames import SourceOptions, find_source, source_names
from cmp_tactile_processing.errors import FrameSourceError, InputError
from cmp_tactile_processing.sensor.description import load_sensor


@pytest.fixture
def _other_package(install_sources):
    """A package with one source that works and one that does not."""
    code = "def open_tape(options):\n    return options.input\n"
    install_sources("other_sources", code, tape="open_tape", bad="nothing")


@pytest.mark.usefixtures("_other_package")
def test_a_source_of_another_package_is_found():
    assert {"images", "video", "tape"} <= set(source_names())
    options = SourceOptions("reel 3", load_sensor("sample_rig"))
    assert find_source("tape")(options) == "reel 3"


@pytest.mark.usefixtures("_other_package")
def test_a_source_that_cannot_be_imported_says_why():
    with pytest.raises(FrameSourceError, match=r"source bad: other_sources:nothing cannot be imp"):
        find_source("bad")


def test_a_library_that_is_not_installed_is_named(monkeypatch):
    """linuxpy, which is needed for cameras alone."""
    for name in [name for name in sys.modules if name.startswith("cmp_tactile_driver.v4l2")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "linuxpy", None)
    monkeypatch.delitem(sys.modules, "linuxpy.video", raising=False)
    with pytest.raises(
        FrameSourceError, match=r"source v4l2: found no .*linuxpy.*: pip install linuxpy$"
    ):
        find_source("v4l2")
    assert find_source("images")


def test_an_unknown_source_names_those_there_are():
    with pytest.raises(InputError, match=r"source: found 'tape', expected one of .*images.*vi"):
        find_source("tape")


def test_the_drivers_own_sources_take_the_options(image_folder, tmp_path):
    sensor = load_sensor("sample_rig")
    with pytest.raises(FrameSourceError, match="expected 1024 x 768 px"):
        find_source("images")(SourceOptions(str(image_folder), sensor)).read()
    folder = tmp_path / "sized"
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), np.zeros((768, 1024), np.uint8))
    images = find_source("images")(SourceOptions(str(folder), sensor, frame_rate=12.0, loop=True))
    assert images.frame_rate == 12.0
    assert [images.read() is not None for _ in range(3)] == [True] * 3
    default = find_source("images")(SourceOptions(str(folder), sensor))
    assert default.frame_rate == 30.0
    assert [default.read() is not None for _ in range(2)] == [True, False]
    path = made_bags.write_video(
        tmp_path / "film.avi", "MJPG", [np.zeros((768, 1024, 3), np.uint8)]
    )
    video = find_source("video")(SourceOptions(str(path), sensor))
    assert video.frame_rate == 25.0
    video.close()
