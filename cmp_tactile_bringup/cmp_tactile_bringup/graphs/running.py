"""What a sensor that runs feels, in a line on the terminal, and what its keys do."""

from __future__ import annotations

import os
import re
import select
import shlex
import shutil
import sys
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from std_srvs.srv import SetBool, Trigger

from cmp_tactile_bringup.graphs.description import Graph
from cmp_tactile_msgs.msg import ForceField
from cmp_tactile_processing.errors import printable
from cmp_tactile_processing.force.advice import SLIP_WORDS, flag_names
from cmp_tactile_processing.measured import ForceFlag, SlipState
from cmp_tactile_processing.ros.process import Listener

RECONSTRUCTOR = "ForceReconstructor"

# How often the line is written again in its place, and below the last one in a file or pipe, s.
REWRITTEN_S = 0.2
APPENDED_S = 5.0
# Of how many frames the rate is that of.
FRAMES_OF_RATE = 40
CLEAR_LINE = "\x1b[K"

LEFT, RIGHT = "left", "right"
ARROWS = {"D": LEFT, "C": RIGHT}
# How soon the reading ends, s.
POLL_S = 0.1
# An arrow, a lone escape, or a letter; not the beginning of an arrow whose rest is to come.
_KEY = re.compile(r"\x1b[\[O][\d;]*([A-Za-z~])|\x1b(?![\[O]|\Z)|[^\x1b]")

PAUSE, QUIT = " ", "q"

# The service that sets displacement and force to zero, below a sensor's namespace.
ZERO = "stereo_triangulator/set_reference"


class RunningLine(Listener):
    """While it lasts, writes what a graph's first sensor feels, and how many frames a second."""

    def __init__(
        self,
        graph: Graph,
        out: TextIO | None = None,
        on_quit: Callable[[], object] = lambda: None,
    ) -> None:
        """Begins with what the user may do next.  on_quit: what the key q does."""
        super().__init__("running_line")
        self._graph, self._out = graph, out or sys.stdout
        self._on_quit = on_quit
        self._calls = key_calls(graph)
        self._clients: dict[str, Any] = {}
        self._paused = any(item.parameters.get("paused") for item in graph.components)
        self._in_place = self._out.isatty() and os.environ.get("TERM") != "dumb"
        self._arrivals: deque[float] = deque(maxlen=FRAMES_OF_RATE)
        self._shown = -APPENDED_S

    def _subscribe(self) -> None:
        self._out.write(next_steps(self._graph))
        namespace = _namespace(self._graph)
        if takes_keys(sys.stdin):
            self._out.write(f"Keys: {keys_line(self._calls)}\n")
            for key, call in self._calls.items():
                kind = SetBool if key == PAUSE else Trigger
                self._clients[key] = self.node.create_client(kind, call.service)
        self.node.create_subscription(ForceField, f"{namespace}/force_field", self._on_force, 10)

    def on_key(self, key: str) -> None:
        """Call the service of a key."""
        if key == QUIT:
            self._on_quit()
        elif key in self._clients:
            request = SetBool.Request(data=not self._paused) if key == PAUSE else Trigger.Request()
            if not self._clients[key].service_is_ready():
                self._write_above(f"{self._calls[key].what}: not ready yet")
                return
            future = self._clients[key].call_async(request)
            future.add_done_callback(partial(self._on_answer, key))

    def _on_answer(self, key: str, future: Any) -> None:
        answer = future.result()
        if key == PAUSE and answer.success:
            self._paused = answer.message == "paused"
        result = answer.message or ("done" if answer.success else "refused")
        self._write_above(f"{self._calls[key].what}: {result}")

    def _write_above(self, text: str) -> None:
        """A line that stays, above the one that is written again."""
        with suppress(OSError):
            self._out.write(printable(text) + (f"{CLEAR_LINE}\n" if self._in_place else "\n"))
            self._out.flush()

    def _on_force(self, message: ForceField) -> None:
        now = time.monotonic()
        self._arrivals.append(now)
        if now - self._shown < (REWRITTEN_S if self._in_place else APPENDED_S):
            return
        self._shown = now
        rate = rate_of(self._arrivals)
        line = f"{rate}   {line_of(message)}"
        width = shutil.get_terminal_size().columns - 1
        if self._in_place and len(line) > width:
            line = f"{rate}   {line_of(message, with_std=False)}"
        # The cursor waits at the beginning, so that the next line of a log stands by itself.
        with suppress(OSError):  # the reader of a pipe has gone; the sensor runs on
            self._out.write(f"{line[:width]}{CLEAR_LINE}\r" if self._in_place else f"{line}\n")
            self._out.flush()


@dataclass(frozen=True)
class KeyCall:
    """What a key does, in words, and by which service."""

    what: str
    service: str


def key_calls(graph: Graph) -> dict[str, KeyCall]:
    """The keys of a graph that call a service, those of its first sensor."""
    namespace = _namespace(graph)
    calls = {"z": KeyCall("zero", f"{namespace}/{ZERO}")}
    for item in graph.components:
        if item.plugin.endswith("::Replay"):
            name = item.full_name
            calls[PAUSE] = KeyCall("pause", f"{name}/pause")
            calls["."] = KeyCall("next frame", f"{name}/step")
            calls[LEFT] = KeyCall("1 s back", f"{name}/back")
            calls[RIGHT] = KeyCall("1 s forward", f"{name}/forward")
        elif item.parameters.get("source") == "simulated":
            calls["r"] = KeyCall("restart the scene", f"{namespace}/indenter/reset")
    return calls


def keys_line(calls: Mapping[str, KeyCall]) -> str:
    """The keys and what they do, in one line."""
    named = [f"{'space' if key == PAUSE else key} {call.what}" for key, call in calls.items()]
    return ", ".join([*named, f"{QUIT} quit"])


def next_steps(graph: Graph) -> str:
    """What to do with a sensor that runs, in lines."""
    sensor = _namespace(graph).lstrip("/")
    simulated = any(item.parameters.get("source") == "simulated" for item in graph.components)
    press, listen = _example("move_indenter.py"), _example("listen.py")
    steps = [
        *([(f"python3 {press} {sensor}", "press it")] if simulated else []),
        (f"python3 {listen} {sensor}", "use the force in your own node"),
        ("cmp_tactile record --output my_bag", "record it"),
        (f"cmp_tactile echo /{sensor}/wrench", "see all of a topic, as with ros2 topic echo"),
    ]
    width = max(len(command) for command, _ in steps) + 2
    lines = [f"  {command:<{width}}{what}" for command, what in steps]
    heading = "Ctrl-C ends it. Next, in another terminal (docs/tutorials/first_look.md):"
    ending = "Force on the gel (x, y, z), +- one standard deviation:"
    return "\n".join([heading, *lines, ending, ""])


def _example(name: str) -> str:
    """An example for a command line; in full outside the checkout, if the checkout is known."""
    short = Path("docs", "examples", name)
    full = Path(__file__).resolve().parents[3] / short
    return shlex.quote(str(full if full.is_file() and not short.is_file() else short))


def _namespace(graph: Graph) -> str:
    """That of the first sensor's forces; empty where a graph has none."""
    found = (item.namespace for item in graph.components if item.plugin.endswith(RECONSTRUCTOR))
    return next(found, "").rstrip("/")


def line_of(field: ForceField, *, with_std: bool = True) -> str:
    """Force on the gel with its standard deviations, contacts, slip, flags."""
    flags = ForceFlag(field.flags)
    named = f"   [{flag_names(flags)}]" if flags else ""
    force = field.wrench.force
    if force.z != force.z:
        return f"force unknown{named}"
    variances = [max(field.wrench_covariance[7 * k], 0.0) for k in range(3)]
    values = " ".join(f"{value:6.3f}" for value in (force.x, force.y, force.z))
    deviations = " ".join(f"{variance**0.5:.3f}" for variance in variances)
    count = len(field.contacts)
    slip = f", {SLIP_WORDS[SlipState(field.slip_state)]}" if count else ""
    contacts = f"{count} contact{'' if count == 1 else 's'}{slip}"
    std = f", +- {deviations}" if with_std else ""
    return f"{values} N{std}   {contacts}{named}"


def rate_of(arrivals: Sequence[float]) -> str:
    """Frames a second over these times, s."""
    if len(arrivals) < 2:
        return " - - Hz"
    return f"{(len(arrivals) - 1) / max(arrivals[-1] - arrivals[0], 1e-3):4.1f} Hz"


def takes_keys(stream: TextIO | None) -> bool:
    """Whether somebody may press keys: it is a terminal, and this process is in its foreground."""
    try:
        return stream is not None and stream.isatty() and _is_foreground(stream.fileno())
    except (OSError, ValueError):  # closed
        return False


@contextmanager
def pressed_keys(on_key: Callable[[str], object], stream: TextIO | None = None) -> Iterator[None]:
    """While it lasts, `on_key` gets each key from a thread: a letter, or one of ARROWS.

    Nothing is read, and nothing set, where the stream (stdin) is no terminal, or that of others.
    At the end the terminal is as it was.  Ctrl-C goes on to be a signal.
    """
    stream = sys.stdin if stream is None else stream
    if not takes_keys(stream):
        yield
        return
    number = stream.fileno()
    before = termios.tcgetattr(number)
    ended = threading.Event()
    tty.setcbreak(number, termios.TCSANOW)
    reader = threading.Thread(target=_read, args=(number, on_key, ended), name="keys", daemon=True)
    reader.start()
    try:
        yield
    finally:
        ended.set()
        reader.join()
        _set(number, before)


def _read(number: int, on_key: Callable[[str], object], ended: threading.Event) -> None:
    text, ours = "", True
    while not ended.is_set():
        if not _is_foreground(number):  # stopped by Ctrl-Z, then sent to the background
            ours = ended.wait(POLL_S)
            continue
        if not ours:
            tty.setcbreak(number, termios.TCSANOW)
            ours = True
        if not select.select([number], [], [], POLL_S)[0]:
            continue
        try:
            read = os.read(number, 64)
        except OSError:
            return
        if not read:  # the terminal is gone
            return
        text += read.decode(errors="ignore")
        while key := _KEY.match(text):
            text = text[key.end() :]
            on_key(ARROWS.get(key[1], "") if key[1] else key[0])


def _is_foreground(number: int) -> bool:
    """Whether reading or setting the terminal does not stop this process."""
    try:
        return os.tcgetpgrp(number) == os.getpgrp()
    except OSError:
        return False


def _set(number: int, attributes: list[Any]) -> None:
    if _is_foreground(number):
        with suppress(termios.error):  # the terminal is gone
            termios.tcsetattr(number, termios.TCSANOW, attributes)
