"""docs/tutorials/record_replay.md: what it records is there, its other commands are commands."""

from __future__ import annotations

import array
import shlex
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
from documents import assert_printed, shell_lines, shown_after

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from sensor_msgs.msg import Image

from cmp_tactile_bringup.command import main
from cmp_tactile_bringup.commands import parse
from cmp_tactile_bringup.recordings.library import required_sensor
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing.nodes.view_splitter import ViewSplitter

TUTORIAL = Path(__file__).resolve().parents[3] / "docs" / "tutorials" / "record_replay.md"
PERIOD_S = 0.1
SHOWN_AFTER = "cmp_tactile record --output my_bag --duration 10"


def commands() -> list[list[str]]:
    """The arguments of every line of the tutorial's shell blocks."""
    lines = list(map(shlex.split, shell_lines(TUTORIAL.read_text(encoding="utf-8"))))
    assert {line[0] for line in lines} == {"cmp_tactile"}
    return [line[1:] for line in lines]


def publish_until(over: threading.Event, publisher: object) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, 768 * 1024, np.uint8).tobytes()
    image = Image(height=768, width=1024, encoding="mono8", step=1024)
    image.data = array.array("B", pixels)
    while not over.wait(PERIOD_S):
        publisher.publish(image)


def test_the_commands_are_commands():
    for words in commands():
        parse(words)


def test_the_first_recording(ros, tmp_path, monkeypatch, capsys):
    """With a splitter and frames in place of the whole sensor, for less long."""
    (words,) = [words for words in commands() if words[:3] == ["record", "--output", "my_bag"]]
    words[words.index("--duration") + 1] = "0.5"
    monkeypatch.chdir(tmp_path)
    interrupt = signal.getsignal(signal.SIGINT)
    ros.start(ViewSplitter)
    publisher = ros.node.create_publisher(Image, "image_raw", 10)
    over = threading.Event()
    spinner = threading.Thread(target=ros.executor.spin, daemon=True)
    feeder = threading.Thread(target=publish_until, args=(over, publisher), daemon=True)
    spinner.start()
    feeder.start()
    try:
        assert main([*words, "--namespace", ros.namespace]) == 0
    finally:
        over.set()
        feeder.join()
        ros.executor.shutdown()
        spinner.join()
        signal.signal(signal.SIGINT, interrupt)
    printed = capsys.readouterr().out.replace(ros.namespace, "/sample_rig")
    # Of the nodes that the tutorial starts, this graph has none that publishes the others.
    here = ("/image_raw", "/tf:", "my_bag:")
    shown = [line for line in shown_after(TUTORIAL, SHOWN_AFTER) if any(t in line for t in here)]
    assert len(shown) == len(here)
    # How many there are depends on the machine.
    assert_printed(shown, printed, absolute=1e9, whole=False)
    assert len(list(BagReader(Path("my_bag")).frames())) >= 5
    # What a replay of it takes for its sensor.
    assert required_sensor(Path("my_bag"), None) == "my_bag/sensor.yaml"
