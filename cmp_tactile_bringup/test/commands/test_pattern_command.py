"""`cmp_tactile pattern`: its files, what it says of them, and mistakes in one line."""

import re
import shlex
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from command_output import run
from documents import shell_lines

from cmp_tactile_bringup.commands import description
from cmp_tactile_bringup.printing.files import FORMATS, svg_bytes
from cmp_tactile_processing.printing.pattern import (
    PROCESSES,
    PrintOptions,
    advise,
    printed_pattern,
)
from cmp_tactile_processing.printing.sheet import PAPERS, print_sheet
from cmp_tactile_processing.sensor.description import (
    SensorDescription,
    load_sensor,
    write_sensor_description,
)
from cmp_tactile_processing.sensor.dot_code import LARGEST_SEED
from cmp_tactile_processing.sensor.parts import CODES, MAX_CORNERS, MIN_CORNERS, CalibrationRecord

TUTORIAL = Path(__file__).resolve().parents[3] / "docs" / "print.md"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with my_sensor.yaml in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    write_sensor_description("my_sensor.yaml", replace(load_sensor("sample_rig"), name="my_sensor"))
    return tmp_path


pattern = partial(run, "pattern")


def test_the_files_lie_here_under_the_name_of_the_description(folder, capsys):
    pytest.importorskip("ezdxf")
    pytest.importorskip("reportlab")
    assert pattern("my_sensor.yaml") == 0
    names = [f"my_sensor_pattern.{suffix}" for suffix in ("svg", "pdf", "dxf", "yaml")]
    out, err = capsys.readouterr()
    assert re.findall(r"Written: (.*)", out) == names
    assert err == ""
    assert {path.name for path in folder.iterdir()} == {"my_sensor.yaml", *names}
    for text in ("(30.448, 35.000) mm", "along_axis", "touching side"):
        assert text in out
    assert "Checker side right" in out


def test_changes_are_laid_into_the_description(folder):
    before = SensorDescription.load("my_sensor.yaml")
    options = ["--rows", 12, "--cols", 16, "--pitch", 0.9, "--corner-checker", "light"]
    assert pattern("my_sensor.yaml", *options, "-o", "new/wide.pdf", "--format", "svg") == 0
    after = SensorDescription.load("new/wide.yaml")
    expected = replace(before.pattern, rows=12, cols=16, pitch=0.0009, corner_checker="light")
    assert after.pattern == replace(expected, code="dots")
    assert (folder / "new" / "wide.svg").is_file()
    assert not (folder / "new" / "wide.pdf").exists()


def test_a_code_is_laid_into_the_description_and_taken_out_again(folder, capsys):
    assert pattern("my_sensor.yaml", "--code", "dots", "--code-seed", 5, "--format", "svg") == 0
    shown = capsys.readouterr().out
    assert "code: dots, seed 5" in shown
    assert "checkers of 15.1 px (the smallest) dots can be read" in shown
    coded = SensorDescription.load("my_sensor_pattern.yaml").pattern
    assert (coded.code, coded.code_seed) == ("dots", 5)
    assert pattern("my_sensor_pattern.yaml", "--code", "none", "--format", "svg", "-o", "bare") == 0
    plain = SensorDescription.load("bare.yaml").pattern
    assert plain == SensorDescription.load("my_sensor.yaml").pattern


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("", ""),
        ("--code-seed 9", ""),
        ("--code none", None),
        ("--rows 4 --cols 4", "25 checkers are too few, 42 are needed"),
        ("--pitch 0.5", "px in the image, 15 px are needed"),
        ("--ink-gain 70", "the ink would fill the dots"),
        ("--pitch 0.5 --code dots", ""),
    ],
)
def test_dots_are_printed_where_they_cost_nothing(words, reason, folder, capsys):
    assert pattern("my_sensor.yaml", *words.split(), "--format", "svg") == 0
    shown, made = capsys.readouterr().out, SensorDescription.load("my_sensor_pattern.yaml").pattern
    assert made.code == ("none" if reason != "" else "dots")
    assert made.code_seed == (9 if "9" in words else 0)
    assert ("--code dots prints dots all the same" in shown) == bool(reason)
    assert (reason or "") in shown


@pytest.mark.parametrize(
    ("words", "options", "mirrored"),
    [
        ("", PrintOptions(), False),
        ("--mirror --invert", PrintOptions(invert=True), True),
        (
            "--process unrolled --ink-gain 20 --margin 1.5 --bleed 0.5",
            PrintOptions(process="unrolled", ink_gain=2e-5, margin=0.0015, bleed=0.0005),
            False,
        ),
    ],
)
def test_the_options_reach_the_sheet(words, options, mirrored, folder):
    assert pattern("my_sensor.yaml", *words.split(), "--format", "svg") == 0
    sensor = SensorDescription.load("my_sensor_pattern.yaml")
    sheet = print_sheet("my_sensor", printed_pattern(sensor, options), mirrored=mirrored)
    expected = svg_bytes(sheet, "my_sensor")
    assert Path("my_sensor_pattern.svg").read_bytes() == expected


def test_the_advised_pattern_is_taken(folder, capsys):
    advice = advise(SensorDescription.load("my_sensor.yaml"))
    assert pattern("my_sensor.yaml", "--advised", "--format", "svg") == 0
    made = SensorDescription.load("my_sensor_pattern.yaml").pattern
    assert (made.rows, made.cols, made.pitch) == (advice.rows, advice.cols, advice.pitch)
    assert made.points_per_segment == advice.points_per_segment
    assert f"{advice.least_side_px:.1f} px at least" in capsys.readouterr().out


def test_what_is_there_is_replaced_only_with_overwrite(folder, capsys):
    assert pattern("my_sensor.yaml", "--format", "svg") == 0
    before = Path("my_sensor_pattern.svg").read_bytes()
    assert pattern("my_sensor.yaml", "--format", "svg", "--mirror") == 1
    expected = "error: my_sensor_pattern.svg: exists already; --overwrite replaces it\n"
    assert capsys.readouterr().err == expected
    assert Path("my_sensor_pattern.svg").read_bytes() == before
    assert pattern("my_sensor.yaml", "--format", "svg", "--mirror", "--overwrite") == 0
    assert Path("my_sensor_pattern.svg").read_bytes() != before


def test_the_description_that_is_read_is_never_replaced(folder, capsys):
    before = Path("my_sensor.yaml").read_bytes()
    assert pattern("my_sensor.yaml", "-o", "my_sensor", "--overwrite") == 1
    assert "my_sensor.yaml: is the input, so it is not replaced" in capsys.readouterr().err
    assert [path.name for path in folder.iterdir()] == ["my_sensor.yaml"]
    assert Path("my_sensor.yaml").read_bytes() == before


@pytest.mark.parametrize(("library", "suffix"), [("ezdxf", "dxf"), ("reportlab", "pdf")])
def test_without_a_library_the_other_files_are_written(
    library, suffix, folder, monkeypatch, capsys
):
    monkeypatch.setitem(sys.modules, library, None)
    assert pattern("my_sensor.yaml") == 0
    (warning,) = capsys.readouterr().err.splitlines()
    assert warning.startswith(f"warning: my_sensor_pattern.{suffix}: ")
    assert warning.endswith(f"pip install {library}")
    assert Path("my_sensor_pattern.svg").is_file()
    assert Path("my_sensor_pattern.yaml").is_file()
    assert not Path(f"my_sensor_pattern.{suffix}").exists()
    # Asked for by name, it is a failure, and there is no description of what was not printed.
    assert pattern("my_sensor.yaml", "-o", "other", "--format", suffix) == 1
    assert not Path("other.yaml").exists()


def test_a_name_with_signs_of_every_format_is_printed(folder):
    """XML's signs, DXF's control codes, and letters that the PDF's fonts do not have."""
    sensor = replace(load_sensor("sample_rig"), name="<a & b> 100%%c 指")
    write_sensor_description("my_sensor.yaml", sensor)
    assert pattern("my_sensor.yaml", "-o", "odd") == 0
    root = ET.parse("odd.svg").getroot()  # noqa: S314
    texts = [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]
    assert sensor.name in texts
    ezdxf = pytest.importorskip("ezdxf")
    lines = [text.dxf.text for text in ezdxf.readfile("odd.dxf").modelspace().query("TEXT")]
    assert "<a & b> 100% %c 指" in lines


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--rows", "3"], 2, "--rows: found '3', expected a whole number from 4 to 60"),
        (["--pitch", "0.0007"], 2, "found '0.0007', expected a number from 0.01 to 100 mm"),
        (["--format", "svg,png"], 2, "found 'svg,png', expected one or more of svg, pdf and dxf"),
        (["--paper", "A3"], 2, "--paper: found 'A3', expected one of A4, letter, fit"),
        (
            ["--code", "none", "--code-seed", "5"],
            1,
            "found 5, expected no such key without code: dots (with",
        ),
        (["--code", "dots", "--ink-gain", "120"], 1, "expected 0 to less than 62.14 um"),
        (["--advised", "--rows", "9"], 2, "--advised replaces --rows, --cols and --pitch"),
        (["-o", "."], 1, "error: .: found a folder, expected a name, as my_pattern"),
        (["--ink-gain", "400"], 1, "error: ink gain: found 400 um, expected 0 to less than 345.2"),
        (["--pitch", "1.2", "--rows", "19"], 1, "(with --rows 19 --pitch 1.2)"),
        (["-o", "my_sensor.yaml/x"], 1, "error: my_sensor.yaml"),
    ],
)
def test_mistakes_are_one_line(options, code, message, folder, capsys):
    assert pattern("my_sensor.yaml", *options) == code
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert [path.name for path in folder.iterdir()] == ["my_sensor.yaml"]


def test_limits_and_choices_are_those_of_the_modules_that_do_the_work():
    found = description.FEWEST_CORNERS, description.MOST_CORNERS
    assert found == (MIN_CORNERS, MAX_CORNERS)
    assert description.FORMATS == FORMATS
    assert tuple(PAPERS) == description.PAPERS
    assert description.PROCESSES == PROCESSES
    assert (description.CODES, description.LARGEST_SEED) == (CODES, LARGEST_SEED)


def test_no_advice_of_a_print_that_the_lens_does_not_show_whole(folder, capsys):
    """Sides of such corners are NaN, smaller than nothing and larger than nothing."""
    rig = SensorDescription.load("my_sensor.yaml")
    assert rig.camera is not None
    camera = replace(rig.camera, distortion=(-1.5, 0.0, 0.0, 0.0, 0.0))
    write_sensor_description("my_sensor.yaml", replace(rig, camera=camera))
    assert pattern("my_sensor.yaml", "--format", "svg") == 0
    out = capsys.readouterr().out
    assert "some corners are outside the lens's field" in out
    assert re.search(r"Advised +│ not known: views\.(left|right): found corners", out)
    assert "nan" not in out
    assert pattern("my_sensor.yaml", "--advised", "-o", "advised") == 1
    err = capsys.readouterr().err
    assert err.startswith("error: my_sensor.yaml: views.")
    assert "no advice for a print of this size" in err
    assert not list(folder.glob("advised.*"))


def test_the_commands_of_the_tutorial_run(folder):
    pytest.importorskip("ezdxf")
    pytest.importorskip("reportlab")
    # A calibrated file, and the sensor's name is not the file's.
    made = CalibrationRecord("gel", "2026-07-01T12:00:00Z", 10, 0.02, 1e-6, ("camera.fx",), ())
    calibrated = replace(load_sensor("sample_rig"), name="left_finger", calibration=made)
    write_sensor_description("my_sensor.yaml", calibrated)
    text = TUTORIAL.read_text(encoding="utf-8")
    for line in shell_lines(text.replace("\\\n", "")):
        _, command, *words = shlex.split(line, comments=True)
        if command == "pattern":
            assert pattern(*words) == 0, line
    (listed,) = re.findall(r"^\| file \|.*?\n\n", text, re.MULTILINE | re.DOTALL)
    for name in re.findall(r"^\| `(.*?)`", listed, re.MULTILINE):
        assert (folder / name).is_file(), name
