"""Where things lie in windows of four sizes, in a real browser, and that they stay there.

SCREENSHOTS=FOLDER keeps a picture of each window.
"""

import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from cmp_tactile_processing.errors import Finding, Severity
from cmp_tactile_viewer.page.layout import LOST
from cmp_tactile_viewer.page.scene import PRESETS
from cmp_tactile_viewer.snapshot import Action, PassiveSource, ShownSensor

# A screen on a desk, a robot's panel, a tablet, a phone; and the gel's least width in them, px.
WINDOWS = {(1400, 860): 350, (1024, 600): 300, (820, 1180): 350, (390, 844): 230}
LONG = "the gel was not still, and what was measured is that of another place than the one meant; "


class Recorded(PassiveSource):
    """A source with a button for what lasts."""

    def __init__(self, sensors):
        super().__init__(sensors)
        self.state = ""

    def actions(self):
        return {
            self.sensors[0].name: (
                Action("zero", "now is rest", lambda: 3 * LONG),
                Action("record", "on and off", self._press, lambda: self.state),
            )
        }

    def _press(self):
        self.state = "" if self.state else "end recording, 7 s"
        return "done"


@pytest.fixture
def recorded(sensor):
    return Recorded((ShownSensor("thumb", sensor),))


def size_of(window):
    return dict(zip(("width", "height"), window, strict=True))


def keep_picture(tab, name):
    folder = os.environ.get("SCREENSHOTS")
    if folder:
        tab.tab.screenshot(path=str(Path(folder) / f"{name}.png"))


def is_whole(tab, least_px):
    """Whether all of the gel is seen, and larger than that."""
    points = tab.gel_points()
    return len(points) and points[:, 2].all() and np.ptp(points[:, 0]) > least_px


def can_be_scrolled_to(element, window):
    element.scroll_into_view_if_needed()
    box = element.bounding_box()
    # The browser scrolls by whole pixels.
    return (
        min(box["x"], box["y"]) >= -1
        and box["x"] + box["width"] <= window[0] + 1
        and box["y"] + box["height"] <= window[1] + 1
    )


@pytest.mark.parametrize("window", WINDOWS, ids=lambda size: f"{size[0]}x{size[1]}")
def test_the_gel_is_seen_whole_and_all_else_can_be_reached(
    recorded, serve, opened, snapshots, window
):
    page = serve(recorded)
    tab = opened(page, size_of(window))
    page.show_health([Finding(Severity.WARNING, "no frames", about="/thumb/camera")])
    for number in range(30):
        page.show("thumb", replace(snapshots[-1], stamp_ns=snapshots[-1].stamp_ns + number * 10**7))
        tab.tab.wait_for_timeout(20)
    try:
        tab.wait(lambda: is_whole(tab, WINDOWS[window]), "a whole gel")
    finally:
        keep_picture(tab, f"{window[0]}x{window[1]}")
    tab.sees("no frames")
    if window[0] < 500:
        tab.tab.get_by_text("thumb: view").click()
        tab.tab.wait_for_timeout(500)
        keep_picture(tab, f"panels_open_{window[0]}x{window[1]}")
    for text in ("Force, N", "Slip ratio, %", "record", "hold"):
        element = tab.tab.get_by_text(text, exact=True).first
        # Panels may still be growing.
        tab.wait(partial(can_be_scrolled_to, element, window), f"{text} in the window")
        element.hover(trial=True)
    assert tab.tab.get_by_text("thumb: view").count() == 1


def test_each_camera_button_frames_the_gel(source, serve, opened, snapshots):
    """However the camera was turned before."""
    page = serve(source)
    page.show("thumb", snapshots[-1])
    tab = opened(page)
    tab.wait(lambda: is_whole(tab, 200), "a whole gel")
    before = tab.gel_points()
    mouse = tab.tab.mouse
    for preset in PRESETS:
        mouse.move(600, 300)
        mouse.wheel(0, -3000)
        mouse.down(button="right")
        mouse.move(800, 200, steps=3)
        mouse.up(button="right")
        tab.wait(lambda: not is_whole(tab, 200), "a gel that is cut off")
        tab.tab.get_by_text(preset, exact=True).click()
        tab.wait(lambda: is_whole(tab, 200), f"a whole gel: {preset}")
        tab.tab.wait_for_timeout(300)
        points = tab.gel_points()[:, :2]
        keep_picture(tab, preset)
        width, height = np.ptp(points, axis=0)
        expected = {"top": height > 0.5 * width, "side": height < 0.3 * width}
        assert expected.get(preset, np.abs(points - before[:, :2]).max() < 3.0), preset


def test_buttons_stay_where_they_are_whatever_is_said(recorded, serve, opened):
    """Texts from topics are shown as they are."""
    page = serve(recorded)
    tab = opened(page)
    tab.sees("nothing to report yet")
    button = tab.tab.get_by_text("zero", exact=True)
    folder = tab.tab.get_by_text("show", exact=True)
    place, below = button.bounding_box(), folder.bounding_box()
    page.show_health([Finding(Severity.ERROR, LONG, about=f"/thumb/{k}") for k in range(9)])
    tab.sees("/thumb/8")
    assert button.bounding_box() == place
    button.click()
    tab.sees(LONG[:40])
    tab.tab.wait_for_timeout(300)
    assert button.bounding_box() == place
    assert folder.bounding_box() == below
    page.show_health(
        [Finding(Severity.WARNING, "<b id=bad>gone</b> & lost", about="/thumb/camera")]
    )
    tab.sees("<b id=bad>gone</b> & lost")
    assert tab.tab.locator("#bad").count() == 0


def test_a_recording_that_goes_on_is_seen(recorded, serve, opened):
    tab = opened(serve(recorded))
    tab.tab.get_by_text("record", exact=True).click()
    tab.sees("end recording, 7 s")
    keep_picture(tab, "recording")
    tab.tab.get_by_text("end recording").click()
    tab.tab.get_by_text("end recording").wait_for(state="hidden")
    assert recorded.state == ""


def test_a_page_without_its_server_says_so_and_one_with_it_does_not(
    source, serve, opened, snapshots
):
    page = serve(source)
    page.show("thumb", snapshots[-1])
    page.show_health([Finding(Severity.OK, "all is well", about="/thumb/camera")])
    tab = opened(page)
    tab.sees("all is well")
    # Longer than the page is silent without a server.
    tab.tab.wait_for_timeout(6000)
    assert tab.is_on_top("all is well")
    assert not tab.tab.get_by_text(LOST).is_visible()
    page.close()
    tab.sees(LOST)
    tab.wait(lambda: not tab.is_on_top("all is well"), "the health to be covered")
    keep_picture(tab, "lost")
