"""`cmp_tactile init` writes a description that the sensor's own picture can be tracked with."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import pytest

from cmp_tactile_bringup.command import main
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.tracking.tracker import GridTracker

PICTURE = Path(__file__).parents[3] / "test" / "data" / "photographs" / "wave_rest.png"


@pytest.fixture
def picture(tmp_path):
    return shutil.copy(PICTURE, tmp_path / "gel.png")


def test_a_description_is_written_with_which_the_picture_is_tracked(picture, tmp_path, capsys):
    path = tmp_path / "mine.yaml"
    assert main(["init", str(picture), "--pitch", "1.5", "-o", str(path)]) == 0
    sensor = load_sensor(str(path))
    assert sensor.name == "mine"
    assert sensor.pattern.pitch == pytest.approx(0.0015)
    assert "young: 500000.0  # assumed" in path.read_text()
    image = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    assert GridTracker(sensor).track(image).found_fraction == 1
    rows, cols = sensor.pattern.rows, sensor.pattern.cols
    assert f"{rows} x {cols} corners" in capsys.readouterr().out


def test_a_file_that_is_there_is_kept(picture, tmp_path, capsys):
    path = tmp_path / "mine.yaml"
    path.write_text("precious")
    assert main(["init", str(picture), "--pitch", "1.5", "-o", str(path)]) == 1
    assert path.read_text() == "precious"
    assert "--output names another" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["nowhere.png", "text.png"])
def test_what_is_no_picture_is_named(name, tmp_path, capsys):
    (tmp_path / "text.png").write_text("no picture")
    output = tmp_path / "mine.yaml"
    words = ["init", str(tmp_path / name), "--pitch", "1", "-o", str(output)]
    assert main(words) == 1
    assert f"{name}: found nothing that can be read" in capsys.readouterr().err
    assert not output.exists()


def test_without_a_terminal_the_pitch_must_be_given(picture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(SystemExit, match="2"):
        main(["init", str(picture), "-o", str(tmp_path / "mine.yaml")])
    assert "--pitch" in capsys.readouterr().err
