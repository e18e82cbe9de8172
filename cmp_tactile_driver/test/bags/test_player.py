"""The player sends every message once, in order, in the recorded timing."""

import threading
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest
from waiting import wait_until

from cmp_tactile_driver.bags import player as player_module
from cmp_tactile_driver.bags.player import PREFETCH_DEPTH, Player, PlayerState, StartGate
from cmp_tactile_driver.bags.reader import RecordedCameraInfo, RecordedFrame, RecordedMessage
from cmp_tactile_driver.bags.timeline import WHOLE, TimeSpan
from cmp_tactile_driver.sources.capture import Pacer
from cmp_tactile_driver.sources.frames import SourceHealth
from cmp_tactile_driver.sources.parameters import ReplayParameters
from cmp_tactile_processing.errors import FrameSourceError

FRAME_NS = 10_000_000
IMAGE = np.zeros((2, 2), np.uint8)


class _Recording:
    """Ten frames, 10 ms apart."""

    name = "ten frames"
    has_camera_info = False
    health = SourceHealth()

    def __init__(self, error: Exception | None = None) -> None:
        self._error = error

    duration = 9 * FRAME_NS * 1e-9

    def messages(self, span: TimeSpan = WHOLE) -> Iterator[RecordedFrame]:
        for number in range(10):
            if self._error is not None and number == 3:
                raise self._error
            time_s = number * FRAME_NS * 1e-9
            if time_s in span:
                yield RecordedFrame(time_s, number * FRAME_NS, number, "camera", IMAGE)


def _wait(condition: Callable[[], object]) -> None:
    wait_until(condition, "the player")


def _wait_finished(player: Player) -> None:
    _wait(lambda: player.progress.state is PlayerState.FINISHED)


def _play(options: ReplayParameters, *recordings: _Recording) -> tuple[Player, list[int]]:
    sent: list[int] = []
    player = Player(recordings or [_Recording()], lambda m: sent.append(m.stamp_ns), options)
    player.start()
    return player, sent


@pytest.mark.parametrize(
    ("options", "recordings", "wanted"),
    [
        (ReplayParameters(), 1, range(10)),
        (ReplayParameters(start=0.035), 1, range(4, 10)),
        (ReplayParameters(start=0.015, end=0.045), 1, range(2, 5)),
        (ReplayParameters(rate=10.0), 2, [*range(10), *range(10)]),
        # The second recording begins where the first one's last frame is, at 90 ms.
        (ReplayParameters(start=0.1, end=0.15), 2, range(1, 6)),
    ],
)
def test_all_that_is_asked_for_comes_in_order(options, recordings, wanted):
    player, sent = _play(options, *(_Recording() for _ in range(recordings)))
    _wait_finished(player)
    assert sent == list(wanted)
    assert (player.progress.frames, player.progress.passes) == (len(sent), 1)


def test_never_faster_than_asked():
    begin = time.monotonic()
    player, _ = _play(ReplayParameters(rate=0.5))
    _wait_finished(player)
    # Nine intervals of 20 ms; being late may be made good by 5 ms at most.
    assert time.monotonic() - begin >= 9 * 0.020 - 0.005


def test_slow_receiver_loses_nothing():
    sent = []

    def send(message: RecordedFrame) -> None:
        time.sleep(0.03)
        sent.append(message.stamp_ns)

    player = Player([_Recording()], send, ReplayParameters(rate=10.0))
    player.start()
    _wait_finished(player)
    assert sent == list(range(10))
    assert player.progress.max_lateness > 0


def test_paused_at_first_and_later():
    sent: list[int] = []

    def send(message: RecordedFrame) -> None:
        sent.append(message.stamp_ns)
        if len(sent) == 3:
            player.set_paused(True)

    player = Player([_Recording()], send, ReplayParameters(paused=True))
    player.start()
    time.sleep(0.1)
    assert sent == []
    assert player.progress.state is PlayerState.PAUSED
    player.set_paused(False)
    _wait(lambda: len(sent) == 3)
    time.sleep(0.1)
    assert len(sent) == 3
    player.set_paused(False)
    _wait_finished(player)
    assert sent == list(range(10))


def test_a_pause_makes_no_frame_late(monkeypatch):
    """On a clock that advances by 100 s in each pause, and not otherwise."""
    now = [0.0]
    monkeypatch.setattr(player_module, "Pacer", partial(Pacer, lambda: now[0]))
    player, sent = _play(ReplayParameters(rate=10.0, paused=True))
    for count in range(1, 4):
        now[0] += 100.0
        assert player.step()
        _wait(lambda count=count: len(sent) == count)
    player.set_paused(False)
    _wait_finished(player)
    assert player.progress.max_lateness == 0.0


class _WithInfos(_Recording):
    """A camera info with each frame."""

    def messages(self, span: TimeSpan = WHOLE) -> Iterator[RecordedMessage]:
        for frame in super().messages(span):
            yield RecordedCameraInfo(frame.time_s, frame.time_ns, b"")
            yield frame


def test_a_step_sends_all_up_to_the_next_frame():
    sent: list[RecordedMessage] = []
    player = Player([_WithInfos()], sent.append, ReplayParameters(paused=True))
    player.start()
    for frames in (1, 2):
        _wait(player.step)
        _wait(lambda frames=frames: player.progress.frames == frames)
        assert [type(item) for item in sent] == [RecordedCameraInfo, RecordedFrame] * frames
    player.stop()


def test_a_frame_time_passes_between_recordings_that_end_with_a_camera_info(monkeypatch):
    """Messages of one moment follow one another at once; their step is not that of frames."""
    intervals: list[float] = []

    class _Intervals(Pacer):
        def delay(self, interval: float) -> float:
            intervals.append(interval)
            return 0.0

    monkeypatch.setattr(player_module, "Pacer", _Intervals)
    player = Player([_WithInfos(), _WithInfos()], lambda _: None, ReplayParameters())
    player.start()
    _wait_finished(player)
    assert intervals == pytest.approx([0.0, 0.0, *[FRAME_NS * 1e-9, 0.0] * 19])


def test_stop_while_paused_ends_the_thread():
    player, sent = _play(ReplayParameters(paused=True))
    player.stop()
    assert player.progress.state is PlayerState.STOPPED
    assert sent == []


def test_gate_holds_back_the_first_message():
    opened = threading.Event()
    sent: list[int] = []
    gave_up: list[bool] = []
    gate = StartGate(lambda: 0.05 if opened.is_set() else None, 60.0, lambda: gave_up.append(True))
    player = Player([_Recording()], lambda m: sent.append(m.stamp_ns), ReplayParameters(), gate)
    player.start()
    time.sleep(0.1)
    assert sent == []
    assert player.progress.state is PlayerState.WAITING
    opened.set()
    _wait_finished(player)
    assert sent == list(range(10))
    assert gave_up == []


def test_gate_gives_up_waiting():
    gave_up: list[int] = []
    gate = StartGate(lambda: None, 0.05, lambda: gave_up.append(player.progress.frames))
    player = Player([_Recording()], lambda _: None, ReplayParameters(), gate)
    player.start()
    _wait_finished(player)
    assert player.progress.frames == 10
    # Once, before the first frame.
    assert gave_up == [0]


@pytest.mark.parametrize(
    ("start", "error", "wanted", "problem"),
    [
        (0.0, FrameSourceError("bag: damaged"), [0, 1, 2], "bag: damaged"),
        (0.0, RuntimeError("a bug"), [0, 1, 2], "RuntimeError: a bug"),
        (
            5.0,
            None,
            [],
            "ten frames: found no message after start = 5.0 s, expected an earlier start",
        ),
    ],
)
def test_failure_is_reported_after_what_was_good(start, error, wanted, problem):
    player, sent = _play(ReplayParameters(start=start), _Recording(error))
    _wait(lambda: player.progress.state is PlayerState.FAILED)
    assert sent == wanted
    assert player.progress.health.problem == problem


def test_steps_that_are_asked_for_at_once_are_all_made():
    player, sent = _play(ReplayParameters(paused=True))
    _wait(player.step)
    assert player.step()
    assert player.step()
    _wait(lambda: len(sent) == 3)
    time.sleep(0.05)
    assert sent == [0, 1, 2]
    player.stop()


@pytest.mark.parametrize("paused", [False, True])
def test_jump_goes_on_from_there(paused):
    player, sent = _play(ReplayParameters(paused=True))
    _wait(player.step)
    _wait(lambda: sent == [0])
    player.jump(0.065)
    if paused:
        _wait(player.step)
        _wait(lambda: sent == [0, 7])
    player.set_paused(False)
    _wait_finished(player)
    assert sent == [0, 7, 8, 9]


def test_a_jump_by_seconds_shows_the_frame_there_and_stays_within():
    """Also in the second of two recordings."""
    player, _ = _play(ReplayParameters(paused=True, loop=True), _Recording(), _Recording())
    _wait(player.step)
    _wait(lambda: player.progress.frames == 1)
    assert player.progress.position == 0
    duration = _Recording().duration
    assert player.jump_by(duration + 0.025) == pytest.approx(duration + 0.025)
    _wait(lambda: player.progress.position == pytest.approx(duration + 0.03))
    for seconds, position in ((100.0, 2 * duration), (-100.0, 0.0)):
        player.jump_by(seconds)
        _wait(lambda position=position: player.progress.position == pytest.approx(position))
    player.stop()
    assert player.jump_by(-1.0) is None


def test_a_jump_behind_the_end_ends_and_is_no_failure():
    player, sent = _play(ReplayParameters(paused=True))
    player.jump(100.0)
    _wait_finished(player)
    assert sent == []


def test_what_comes_next_is_read_while_it_is_paused():
    """So that neither reading nor decoding delays a frame."""
    read: list[int] = []

    class Watched(_Recording):
        def messages(self, span: TimeSpan = WHOLE) -> Iterator[RecordedFrame]:
            for frame in super().messages(span):
                read.append(frame.stamp_ns)
                yield frame

    player, sent = _play(ReplayParameters(paused=True, loop=True), Watched())
    _wait(lambda: len(read) > 10)
    time.sleep(0.05)
    assert len(read) <= PREFETCH_DEPTH + 1
    assert sent == []
    player.stop()
    assert not [item for item in threading.enumerate() if item.name.startswith("read_ahead")]
