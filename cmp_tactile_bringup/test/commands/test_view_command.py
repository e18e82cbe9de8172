"""`cmp_tactile view` as a process of its own: where it is, who may see it, how it ends."""

import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from command_output import run

from cmp_tactile_bringup.recordings.library import sensor_of_recording
from cmp_tactile_driver.bags.writer import SENSOR_FILE
from cmp_tactile_processing.sensor.description import load_sensor

COMMAND = [sys.executable, "-m", "cmp_tactile_bringup.command", "view"]
TIMEOUT_S = 90.0


@contextmanager
def viewing(*words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The command, and the address that it printed."""
    with subprocess.Popen(
        [*COMMAND, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            line = process.stdout.readline()
            assert line.startswith("Open http"), line + process.stderr.read()
            yield process, line.split()[1]
        finally:
            process.kill()


def status_of(address: str | urllib.request.Request) -> int:
    try:
        with urllib.request.urlopen(address, timeout=TIMEOUT_S) as answer:  # noqa: S310
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


def test_the_page_is_there_until_ctrl_c(grasp_bag):
    with viewing(str(grasp_bag)) as (process, address):
        assert address.startswith("http://127.0.0.1:")
        assert status_of(address) == 200
        process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT_S) == 0
        assert process.stderr.read() == ""


def test_a_recording_without_its_sensor_asks_for_it(grasp_bag, tmp_path, capsys):
    bag = shutil.copytree(grasp_bag, tmp_path / "bag")
    (bag / SENSOR_FILE).unlink()
    assert run("view", bag) == 1
    assert f"{bag}: found no --sensor" in capsys.readouterr().err


@pytest.mark.usefixtures("short_scenes")
def test_results_know_their_sensor_even_if_they_are_cut(grasp_bag, tmp_path):
    assert run("process", grasp_bag, "--output", tmp_path, "--end", "0.1") == 0
    whole, cut = tmp_path / "grasp.mcap", tmp_path / "cut.mcap"
    content = whole.read_bytes()
    cut.write_bytes(content[: len(content) // 2])
    shutil.copy(whole.with_suffix(".yaml"), cut.with_suffix(".yaml"))
    for path in (whole, cut):
        assert load_sensor(sensor_of_recording(str(path))).ros_name == "sample_rig"
    cut.with_suffix(".yaml").unlink()
    assert sensor_of_recording(str(cut)) == ""
