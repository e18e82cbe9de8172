"""Keys of a graph that runs, on a terminal of the test's own."""

import io
import os
import pty
import signal
import subprocess
import sys
import termios
import threading

import pytest
from waiting import wait_until

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")


from cmp_tactile_bringup.graphs.running import pressed_keys

# As a shell starts it: with a terminal of its own, in the foreground.
CHILD = """
import fcntl, os, sys, termios
os.setsid()
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""
# Prints keys until q, an error, or Ctrl-C.
READER = """
import threading
from cmp_tactile_bringup.graphs.running import pressed_keys
ended = threading.Event()

def on_key(key):
    print(repr(key), flush=True)
    if key == "q":
        ended.set()

with pressed_keys(on_key):
    print("ready", flush=True)
    ended.wait()
    print("over", flush=True)
"""


class Terminal:
    """A terminal, and a process on it."""

    def __init__(self, *arguments: str) -> None:
        self.master, slave = pty.openpty()
        self.slave = slave
        self.before = termios.tcgetattr(slave)
        self.process = subprocess.Popen(
            [sys.executable, "-c", CHILD, *arguments], stdin=slave, stdout=slave, stderr=slave
        )
        self.text = ""
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self) -> None:
        try:
            while data := os.read(self.master, 4096):
                self.text += data.decode(errors="replace")
        except OSError:
            return

    def press(self, keys: str) -> None:
        os.write(self.master, keys.encode())

    def shows(self, text: str) -> None:
        wait_until(lambda: text in self.text, f"{text!r} on the terminal, not {self.text!r}")

    def end(self) -> int:
        """The exit code; the terminal is as it was."""
        code = self.process.wait(timeout=120)
        after = termios.tcgetattr(self.slave)
        assert after[3] == self.before[3]
        assert after[:3] == self.before[:3]
        return code

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.slave)
        # Or it would go on reading from the next terminal that gets the same number.
        self.reader.join(timeout=10)
        os.close(self.master)


@pytest.fixture
def terminal():
    made: list[Terminal] = []

    def make(*arguments: str) -> Terminal:
        made.append(Terminal(*arguments))
        return made[-1]

    yield make
    for item in made:
        item.close()


@pytest.mark.parametrize("way", ["q", "Ctrl-C", "SIGTERM"])
def test_the_terminal_is_as_it_was_however_it_ends(terminal, way):
    """Reports of the kind, tried here:
    ros2/rosbag2 1607 (a recorder leaves the terminal without echo): modes are equal before and
    after q, Ctrl-C and an error.
    ros2/rosbag2 1123 (an end by Ctrl-C has an error's exit code): the whole command below has 0.
    """
    shown = terminal("-c", f"import signal\nsignal.signal(15, lambda *_: exit(3))\n{READER}")
    shown.shows("ready")
    assert termios.tcgetattr(shown.slave)[3] & (termios.ICANON | termios.ECHO) == 0
    # An arrow in both of its forms, and one that comes in two parts.
    shown.press("z \x1b[D\x1bOC.\x1b")
    shown.shows("'.'")
    shown.press("[D")
    shown.shows("'left'\r\n'right'\r\n'.'\r\n'left'")
    if way == "SIGTERM":
        shown.process.send_signal(signal.SIGTERM)
    else:
        shown.press("q" if way == "q" else "\x03")
    assert shown.end() == {"q": 0, "Ctrl-C": -signal.SIGINT, "SIGTERM": 3}[way]


def test_nothing_is_read_where_there_is_no_terminal():
    """Report of the kind, tried here: ros2/launch 735 (stdin of a launched process is no terminal):
    what waits in a pipe stays there."""
    read, write = os.pipe()
    os.write(write, b"z")
    keys: list[str] = []
    with os.fdopen(read) as stream, pressed_keys(keys.append, stream):
        assert os.read(read, 1) == b"z"
    os.close(write)
    with pressed_keys(keys.append, io.StringIO("z")):
        pass
    assert keys == []


def test_a_replay_is_paused_stepped_and_ended_by_keys(terminal, grasp_bag):
    """The whole command, with real nodes."""
    command = ["-m", "cmp_tactile_bringup.command", "replay", str(grasp_bag), "loop:=true"]
    shown = terminal(*command)
    shown.shows("Keys: z zero, space pause, . next frame, left 1 s back, right 1 s forward, q quit")
    shown.shows(" Hz ")
    shown.press(" ")
    shown.shows("pause: paused")
    shown.press("\x1b[D")
    shown.shows("1 s back: paused at 0.00 s")
    shown.press(".")
    shown.shows("next frame: done")
    shown.press(" ")
    shown.shows("pause: playing")
    shown.press("q")
    assert shown.end() == 0
    assert "Traceback" not in shown.text
