"""The figures of the plots: in order, in a window, from the beginning where time runs back."""

import numpy as np
import pytest
from made_forces import made_contact, made_field

from cmp_tactile_processing.measured import ForceFlag
from cmp_tactile_viewer.page.plots import History
from cmp_tactile_viewer.snapshot import Snapshot

STEP_NS = 10_000_000


def filled(count, capacity=50):
    history = History(capacity)
    for number in range(count):
        field = made_field(1, 1, wrench=np.full(6, float(number)))
        history.add(Snapshot(5 + number * STEP_NS, force=field, latency_s=0.02))
    return history


def test_the_last_frames_are_kept_in_order():
    window = filled(120).window(100.0)
    assert window["fx"] == pytest.approx(np.arange(70.0, 120.0))
    assert window["time_s"] == pytest.approx(0.01 * np.arange(70.0, 120.0))
    assert window["rate_hz"][-1] == pytest.approx(100.0)
    assert window["latency_ms"] == pytest.approx(20.0)


def test_a_window_ends_where_it_is_scrolled_back_to():
    window = filled(40).window(0.1, back_s=0.2)
    assert window["fx"] == pytest.approx(np.arange(9.0, 20.0))


def test_time_that_runs_back_begins_again():
    history = filled(20)
    history.add(Snapshot(5))
    window = history.window(10.0)
    assert window["time_s"] == pytest.approx([0.0])
    assert np.isnan(window["fx"]).all()


def test_the_axis_of_time_stays_where_a_recording_is_gone_back_in():
    history = filled(20)
    history.add(Snapshot(5 + 7 * STEP_NS))
    assert history.window(10.0)["time_s"] == pytest.approx([0.07])


def test_contact_is_marked_and_what_is_not_known_is_nan():
    history = History()
    history.add(Snapshot(1, force=made_field(1, 1, contacts=(made_contact([0]),))))
    history.add(Snapshot(2, force=made_field(1, 1)))
    history.add(Snapshot(3))
    window = history.window(1.0)
    assert window["contact"] == pytest.approx([1.0, 0.0, np.nan], nan_ok=True)
    assert np.isnan(window["latency_ms"]).all()


def test_what_was_jumped_is_neither_joined_nor_a_rate():
    """leeoniya/uPlot 996: NaN does not break a line, so the part before is shown scrolled back."""
    history = filled(20)
    begin_s = 3.0
    for number in range(5):
        stamp_ns = 5 + round(begin_s * 1e9) + number * STEP_NS
        history.add(Snapshot(stamp_ns, force=made_field(1, 1, wrench=np.full(6, -3.0))))
    window = history.window(20.0)
    assert window["time_s"] == pytest.approx(begin_s + 0.01 * np.arange(5.0))
    assert window["fx"] == pytest.approx(-3.0)
    assert np.isnan(window["rate_hz"][0])
    assert window["rate_hz"][1:] == pytest.approx(100.0)
    assert history.window(20.0, back_s=1.0)["fx"] == pytest.approx(np.arange(20.0))


def test_a_slow_sensor_is_one_line():
    history = History()
    for number in range(5):
        history.add(Snapshot(1 + number * 2_000_000_000))
    assert history.window(20.0)["rate_hz"][1:] == pytest.approx(0.5)


def test_a_doubtful_force_is_marked():
    history = History()
    flags = ForceFlag.ZERO_DOUBTFUL | ForceFlag.AT_BORDER
    history.add(Snapshot(1, force=made_field(1, 1)))
    history.add(Snapshot(2, force=made_field(1, 1, flags=flags)))
    assert history.window(1.0)["doubtful"] == pytest.approx([0.0, 1.0])
    assert history.doubts == "zero_doubtful"
    history.add(Snapshot(3, force=made_field(1, 1)))
    assert not history.doubts
