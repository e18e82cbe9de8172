"""Events keep their intervals, clocks their offset, and a worker the reason of its failure."""

import threading

import pytest

from cmp_tactile_driver.sources.capture import CATCH_UP, Pacer, Worker, on_clock


class _Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_intervals_do_not_drift():
    clock = _Clock()
    pacer = Pacer(clock)
    times = []
    for _ in range(100):
        clock.now += pacer.delay(0.05) + 0.001  # the work itself takes 1 ms
        times.append(clock.now)
    assert times[-1] - times[0] == pytest.approx(99 * 0.05, abs=1e-9)


def test_late_event_moves_the_rest():
    clock = _Clock()
    pacer = Pacer(clock)
    pacer.delay(0.05)
    clock.now += 1.0  # a stall of 20 intervals
    assert pacer.delay(0.05) == 0.0
    assert pacer.delay(0.05) >= 0.05 - CATCH_UP
    assert pacer.max_lateness == pytest.approx(0.95)


def test_restart_is_due_at_once():
    clock = _Clock()
    pacer = Pacer(clock)
    pacer.delay(0.05)
    pacer.restart()
    assert pacer.delay(10.0) == 0.0
    assert pacer.max_lateness == 0.0


def test_stop_ends_a_wait_and_the_work_can_begin_again():
    begun = threading.Semaphore(0)
    stopped = []

    def work():
        begun.release()
        stopped.append(worker.wait(60.0))

    worker = Worker("test", work)
    for count in (1, 2):
        worker.start()
        assert begun.acquire(timeout=20)
        worker.stop()
        worker.stop()
        assert stopped == [True] * count
    assert worker.failure == ""


def test_a_worker_can_stop_itself():
    ended = threading.Event()

    def work():
        worker.stop()
        ended.set()

    worker = Worker("test", work)
    worker.start()
    assert ended.wait(20)


def test_a_time_on_another_clock_is_by_the_reading_that_was_interrupted_least():
    ahead_ns = 1_700_000_000 * 10**9
    # Before each of the three looks at a clock, of five readings; the fourth is the best.
    steps = iter([9, 10**8, 5, 7, 3, 10**6, 10**5, 10**5, 5, 900, 100, 100, 5, 10**7, 10**7])
    now_ns = 10**12

    def monotonic() -> int:
        nonlocal now_ns
        now_ns += next(steps)
        return now_ns

    found_ns = on_clock(10**12, lambda: monotonic() + ahead_ns, monotonic)
    assert found_ns == 10**12 + ahead_ns
