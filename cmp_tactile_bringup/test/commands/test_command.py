"""The command: files that it writes, errors in one line, exit codes."""

import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_output import one_line_error, run

from cmp_tactile_bringup.terminal import shown_stages
from cmp_tactile_processing.sensor.description import find_sensor_description

REPOSITORY = Path(__file__).resolve().parents[3]


def test_the_readme_lists_every_command_and_exit_code():
    readme = REPOSITORY / "cmp_tactile_bringup" / "README.md"
    renew = runpy.run_path(str(REPOSITORY / "docs" / "command_table.py"))["renew"]
    assert readme.read_text(encoding="utf-8") == renew(readme), (
        "run: setup/run python3 docs/command_table.py cmp_tactile_bringup/README.md"
    )


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("", "simulate a sensor in real time"),
        ("--help", "simulate a sensor in real time"),
        *(
            (f"{command} --help", f"cmp_tactile {command}")
            for command in ("demo", "live", "simulate", "process", "replay", "pattern", "info")
        ),
        *(
            (f"calibrate {what} --help", f"  cmp_tactile calibrate {what} ")
            for what in ("board", "gel", "force", "relaxation", "check", "practice")
        ),
    ],
)
def test_every_command_explains_itself_with_an_example(words, shown, capsys):
    assert run(*words.split()) == 0
    assert shown in capsys.readouterr().out.rpartition("example")[2]


def test_the_version_is_that_of_the_package(capsys):
    assert run("--version") == 0
    assert re.fullmatch(r"cmp_tactile \d+\.\d+\.\d+\n", capsys.readouterr().out)


@pytest.mark.parametrize("columns", ["", "0"])
def test_info_shows_geometry_and_versions_and_whole_paths_in_a_pipe(monkeypatch, capsys, columns):
    """Tried with COLUMNS=0: nothing was printed.  As in fish-shell 1613, rapid7/rex-text 71."""
    monkeypatch.setenv("COLUMNS", columns)
    assert run("info", "sample_rig") == 0
    out = capsys.readouterr().out
    for text in ("Baseline", "9.83 mm", "20 x 20 inner corners", "numpy", "prototype"):
        assert text in out
    assert str(find_sensor_description("sample_rig")) in out
    assert "6 virtual markers between" in out


def test_the_sensor_of_images_must_be_named(tmp_path, capsys):
    images = tmp_path / "images"
    images.mkdir()
    (images / "0.png").touch()
    assert run("process", images, "--output", tmp_path / "out") == 1
    one_line_error(capsys, "images: found no --sensor, expected", "prototype, sample_rig")
    assert run("replay", images) == 1
    one_line_error(capsys, "images: found no --sensor, expected", "prototype, sample_rig")
    assert run("replay", "nowhere") == 1
    one_line_error(capsys, "nowhere: found no such file or folder", "grasp")


def test_markup_and_escape_sequences_in_a_name_are_shown_as_they_are(tmp_path, capsys):
    path = tmp_path / "rig.yaml"
    text = find_sensor_description("sample_rig").read_text()
    path.write_text(text.replace("name: sample_rig", 'name: "[bold]x[/] [/] \\e[31mred"'))
    assert run("info", path) == 0
    assert "Sensor [bold]x[/] [/] \\x1b[31mred" in capsys.readouterr().out
    path.write_text(text + '"\\e[31m[/]\\n": 1\n')
    assert run("info", path) == 1
    one_line_error(capsys, "rig.yaml:", ": \\x1b[31m[/]\\n: found 1, expected no such key")


def test_all_that_is_wrong_with_a_file_is_said_at_once(tmp_path, capsys):
    path = tmp_path / "rig.yaml"
    text = find_sensor_description("sample_rig").read_text()
    path.write_text(text.replace("rows: 20", "rows: twenty").replace("poisson: 0.48", "poisson: 4"))
    assert run("info", path) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"error: .*rig.yaml:\d+: pattern.rows: found 'twenty', .*", first)
    assert re.fullmatch(r".*rig.yaml:\d+: elastomer.poisson: found 4, .*", second)


def test_an_unknown_sensor_is_one_line_and_debug_shows_where(capsys):
    assert run("info", "nosuch") == 1
    one_line_error(capsys, "nosuch", "sample_rig")
    assert run("info", "nosuch", "--debug") == 1
    assert "Traceback" in capsys.readouterr().err


# The command as it is, but for the end of `info`, which would come before the last signal.
ENDLESS_INFO = """
import sys, time
from cmp_tactile_bringup import command

def endless(words, interruption, run=command._run):
    run(words, interruption)
    while True:
        time.sleep(0.05)

command._run = endless
sys.exit(command.main())
"""


def catches(pid, number):
    """Whether a process has a handler of its own for a signal."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    mask = status.partition("SigCgt:")[2].split()[0]
    return bool(int(mask, 16) >> (number - 1) & 1)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_the_command_is_loaded_ends_it_with_its_code(number):
    """Python itself has no handler for SIGTERM: once there is one, the command's code runs.

    Reports: ninja-build/ninja 964, DarthSim/overmind 50; tried: the end of the terminal killed
    `process` and `simulate`, and what they had begun stayed.
    """
    command = [sys.executable, "-c", ENDLESS_INFO, "info"]
    processes = [
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    for process, delay_s in zip(processes, (0.0, 0.15, 0.4), strict=True):
        while process.poll() is None and not catches(process.pid, signal.SIGTERM):
            time.sleep(0.001)
        time.sleep(delay_s)
        process.send_signal(number)
    for process in processes:
        _, err = process.communicate(timeout=60)
        assert (process.returncode, err) == (128 + number, "stopped\n")


# What libraries do to an interrupt while they are loaded: numpy's import_array prints and drops
# it, others drop it or make a panic of it.
LOSSES = {
    "dropped": "pass",
    "printed": "sys.excepthook(*sys.exc_info())",
    "panic": "raise Panic from None",
}
LOSING_INFO = """
import sys, time
from cmp_tactile_bringup import command, commands

class Panic(BaseException):
    pass

class Losing:
    debug = False

    def run(self):
        try:
            print("begun", flush=True)
            time.sleep(60)
        except BaseException:
            {loss}
        try:
            time.sleep(60)
        finally:
            time.sleep(0.5)
            print("cleaned")

commands.parse = lambda words: Losing()
sys.exit(command.main())
"""


@pytest.mark.parametrize("loss", LOSSES)
def test_an_interrupt_that_a_library_loses_is_repeated_until_it_ends_the_command(loss):
    """Reports: numpy 14965 and 20596, parsec-cloud 3929; tried: one interrupt in 500 was lost."""
    process = subprocess.Popen(
        [sys.executable, "-c", LOSING_INFO.format(loss=LOSSES[loss])],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "begun\n"
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=50)
    assert (process.returncode, err) == (130, "stopped\n")
    assert out == ("" if loss == "panic" else "cleaned\n")


def _command(*words):
    return [sys.executable, "-m", "cmp_tactile_bringup.command", *words]


@pytest.mark.parametrize("words", [["info"], ["info", "--help"], ["pattern", "--help"]])
def test_a_reader_that_has_gone_is_no_error(words):
    """As in `cmp_tactile info | head -1`, by which a script with pipefail must not end.

    Reports: Textualize/rich 3400, pypa/pip 13878, Backblaze/B2_Command_Line_Tool 1071; tried: the
    exit code was 1.
    """
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            _command(*words), stdout=writer, stderr=subprocess.PIPE, text=True, check=False
        )
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


def test_an_error_is_one_though_nobody_reads_the_output(tmp_path):
    """Of several recordings the later ones are processed, too."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        words = _command("process", str(tmp_path), "--sensor", "sample_rig", "--output", "results")
        done = subprocess.run(words, cwd=tmp_path, stdout=writer, stderr=writer, check=False)
    finally:
        os.close(writer)
    assert done.returncode == 1


UNTIL_STOPPED = """
import signal, sys
from cmp_tactile_processing.processes import StopSignal

if sys.argv[1:] == ["nohup"]:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
stop = StopSignal()
signal.raise_signal(signal.SIGHUP)
print(stop.wait(0.1))
"""


@pytest.mark.parametrize(("words", "stops"), [([], "True\n"), (["nohup"], "False\n")])
def test_a_closed_terminal_ends_in_order_what_runs_in_it(words, stops):
    """So that a recording gets its index; tried: the process was killed.  Not under `nohup`.

    Reports: ros2/rosbag2 791 and 901.
    """
    command = [sys.executable, "-c", UNTIL_STOPPED, *words]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    assert done.stdout == stops


def test_a_path_that_the_terminal_cannot_show_is_shown_by_its_numbers(tmp_path):
    """Tried: an error in place of the table.

    Reports: Textualize/rich 212, politeauthority/docker-pretty-ps 22.
    """
    path = tmp_path / "größe Ω.yaml"
    shutil.copy(find_sensor_description("sample_rig"), path)
    done = subprocess.run(
        _command("info", str(path)),
        env=os.environ | {"PYTHONIOENCODING": "latin-1"},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert r"größe \u03a9.yaml".encode("latin-1") in done.stdout


def test_a_misspelt_subcommand_is_asked_about(capsys):
    assert run("calibrate", "bord") == 2
    assert "did you mean 'board'?" in capsys.readouterr().err


def test_in_a_pipe_each_stage_is_a_line_as_it_begins(capsys):
    """Reports of the kind, tried here:

    basicmachines-co/basic-memory 579 (74 s of silence where the output is captured, the bar at the
    end), smart-on-fhir/cumulus-etl 323 (nothing in a log file while it works): a line is there
    before the stage ends.
    """
    with shown_stages() as show:
        show("simulating", 0.0)
        assert "simulating ...\n" in capsys.readouterr().err
        show("simulating", 0.5)
        assert "simulating ..." not in capsys.readouterr().err
        show("drawing", 0.0)
        assert "drawing ...\n" in capsys.readouterr().err
