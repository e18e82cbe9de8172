"""`cmp_tactile calibrate`: what is refused, what is printed, and that nothing is then written."""

from functools import partial

import cv2
import pytest
from command_output import printed, run

from cmp_tactile_driver.bags.reader import BagReader

BOARD = ("--board", "9x6", "--square", "0.0011")
WEIGHTS, FORCE = ("--weights", "w"), ("--sensor", "s", "--output", "o.yaml")
# In the contact recording: the first frame at rest, and those in which the gel is pressed.
PRESSED = slice(6, 13)


calibrate = partial(run, "calibrate")


def write(folder, images):
    folder.mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"{k:02d}.png"), image)
    return folder


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("gel", "--sensor", "s", "--output", "o.yaml"), "INPUT or --topic is required"),
        (("check", "--topic", "/t"), "--sensor is required with --topic"),
        (("board", *BOARD, "--output", "o"), "one of INPUT, --topic and --left"),
        (("board", "in", *BOARD, "--output", "o"), "--sensor is required"),
        (("board", "in", *BOARD, "--right", "r.png", "--output", "o"), "--right needs --left"),
        (
            ("board", "in", *BOARD, "--sensor", "s", "--charuco", "D", "--output", "o"),
            "--charuco and --marker",
        ),
        (("board", "in", "--board", "9by6", "--square", "1", "--output", "o"), "as 9x6"),
        (("practice", "--output", "o", "--seed", "-1"), "a whole number from 0"),
        (("force", "bag", "--output", "o.yaml"), "one of --weights and --wrench-topic"),
        (
            ("force", "bag", *WEIGHTS, *("--wrench-topic", "/f", "--output", "o")),
            "not allowed with",
        ),
        (("force", *FORCE, "--wrench-topic", "/f"), "--wrench-topic needs INPUT"),
        (("force", *WEIGHTS, "--output", "o.yaml"), "--sensor is required"),
        (("force", "bag", *WEIGHTS, "--rest", 2, 1, "--output", "o.yaml"), "FROM must be below"),
        (("force", "bag", *WEIGHTS, "--poisson-std", 9, "--output", "o.yaml"), "from 0 to 0.1"),
    ],
)
def test_a_wrong_usage_is_reported_before_any_work(arguments, complaint, capsys):
    assert calibrate(*arguments) == 2
    assert complaint in printed(capsys)


def test_frames_in_contact_are_refused_and_an_earlier_file_stays(practice_set, tmp_path, capsys):
    frames = [frame.image for frame in BagReader(practice_set / "contact").frames()]
    pressed = write(tmp_path / "pressed", frames[PRESSED])
    new = tmp_path / "new.yaml"
    new.write_text("precious")
    given = (pressed, "--sensor", practice_set / "truth" / "sensor.yaml", "--output", new)
    assert calibrate("gel", *given) == 1
    assert "new.yaml: exists already; --overwrite replaces it" in printed(capsys)
    assert not (tmp_path / "new_calibration").exists()
    assert calibrate("gel", *given, "--overwrite") == 1
    said = printed(capsys)
    assert "error: " in said
    assert "what to do: " in said
    assert "Nothing else was written" in said
    assert new.read_text() == "precious"
    assert not (tmp_path / "new_left.yaml").exists()
    page = (tmp_path / "new_calibration" / "index.html").read_text()
    assert "Refused" in page
    assert (tmp_path / "new_calibration" / "residuals.png").is_file()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("gel", "nowhere", "--output", "new.yaml"), "nowhere: found no such file or folder"),
        (("gel", "rest", "--output", "new.txt"), "found the suffix '.txt', expected .yaml"),
        (
            ("gel", "rest", "--start", "99", "--output", "new.yaml"),
            "found no frame from 99 ",
        ),
        (("board", "board", *BOARD, "--charuco", "DICT_9", "--marker", "0.001"), "dictionary"),
    ],
)
def test_a_wrong_input_is_one_line(arguments, complaint, practice_set, monkeypatch, capsys):
    monkeypatch.chdir(practice_set)
    if "--output" not in arguments:
        arguments += ("--output", "new.yaml")
    assert calibrate(*arguments, "--sensor", "sensor.yaml") == 1
    said = printed(capsys)
    assert said.count("error: ") == 1
    assert complaint in said
    assert not (practice_set / "new.yaml").exists()


def test_a_practice_set_needs_a_new_folder(tmp_path, capsys):
    (tmp_path / "thesis.txt").write_text("precious")
    assert calibrate("practice", "--output", tmp_path) == 1
    assert "exists already, expected a new folder" in printed(capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
