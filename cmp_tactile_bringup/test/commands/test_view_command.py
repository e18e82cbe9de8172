"""`cmp_tactile view` as a process of its own: where it is, who may see it, how it ends."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from cmp_tactile_bringup.command import main
from cmp_tactile_bringup.recordings.library import sensor_of_recording
from cmp_tactile_driver.bags.writer import SENSOR_FILE
from cmp_tactile_processing.sensor.description import load_sensor

COMMAND = [sys.executable, "-m", "cmp_tactile_bringup.command", "view"]
TIMEOUT_S = 90.0
FORBIDDEN = 403
EVERYWHERE = "0.0.0.0"  # noqa: S104


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


def test_a_page_with_a_token_is_for_those_who_have_it(grasp_bag):
    with viewing(str(grasp_bag), "--token", "secret", "--read-only") as (_, address):
        assert address.endswith("/?token=secret")
        assert status_of(address) == 200
        assert status_of(address.replace("secret", "guess")) == FORBIDDEN


def test_it_says_who_else_may_press_the_buttons(grasp_bag):
    with viewing(str(grasp_bag), "--host", EVERYWHERE) as (process, address):
        process.send_signal(signal.SIGINT)
        process.wait(TIMEOUT_S)
        port = address.rpartition(":")[2]
        expected = (
            f"warning: listening on {EVERYWHERE}, port {port}: anyone on that network can press"
        )
        assert process.stderr.read().startswith(expected)


@pytest.mark.usefixtures("own_signals")
def test_a_taken_port_is_named(grasp_bag, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["view", str(grasp_bag), "--port", str(port)]) == 1
    assert f"cannot listen on 127.0.0.1, port {port}" in capsys.readouterr().err


def test_a_recording_without_its_sensor_asks_for_it(grasp_bag, tmp_path, capsys):
    bag = shutil.copytree(grasp_bag, tmp_path / "bag")
    (bag / SENSOR_FILE).unlink()
    assert main(["view", str(bag)]) == 1
    assert f"{bag}: found no --sensor" in capsys.readouterr().err


@pytest.mark.usefixtures("short_scenes")
def test_results_know_their_sensor_even_if_they_are_cut(grasp_bag, tmp_path):
    assert main(["process", str(grasp_bag), "--output", str(tmp_path), "--end", "0.1"]) == 0
    whole, cut = tmp_path / "grasp.mcap", tmp_path / "cut.mcap"
    content = whole.read_bytes()
    cut.write_bytes(content[: len(content) // 2])
    for path in (whole, cut):
        assert load_sensor(sensor_of_recording(str(path))).ros_name == "sample_rig"
    cut.write_bytes(content[:1000])
    assert sensor_of_recording(str(cut)) == ""
