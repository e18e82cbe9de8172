"""The page in a real browser: what is drawn is read back from the scene, not from a picture."""

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_viewer.recording import open_source
from cmp_tactile_viewer.snapshot import (
    Action,
    Body,
    PassiveSource,
    Pose,
    Setting,
    ShownSensor,
    Touch,
)

BUTTON = "press me"


def test_the_surface_moves_when_the_gel_is_pressed(source, serve, opened, snapshots):
    """The highest point of the mesh is that of the measured surface, a dome that is pressed in."""
    page = serve(source)
    page.show("thumb", snapshots[0])
    tab = opened(page)
    rows, cols = source.sensors[0].description.pattern.shape.corners
    tab.wait(lambda: tab.meshes()[0] >= (2 * rows - 1) * (2 * cols - 1), "the whole surface")
    at_rest = tab.meshes()[1]
    page.show("thumb", snapshots[-1])
    expected = 1e3 * np.nanmax(snapshots[-1].surface.position[..., 2])
    assert expected < at_rest - 0.3
    tab.wait(lambda: abs(tab.meshes()[1] - expected) < 0.05, "the pressed surface")
    assert not tab.console
    # And asks no other server for anything.
    own = (page.url, page.url.replace("http", "ws"), "blob:", "data:")
    assert [url for url in tab.requests if not url.startswith(own)] == []


# Of each mesh: number of points, and where its origin is.
PLACES = """() => window.gels().map(mesh => {
  mesh.updateWorldMatrix(true, false);
  return [mesh.geometry.attributes.position.count, ...mesh.matrixWorld.elements.slice(12, 15)];
})"""
# Of what two fingers hold; none of its triangles shares a point.
TRIANGLES = np.random.default_rng(0).normal(size=(12, 3, 3), scale=0.01)


def test_two_fingers_and_what_they_hold_are_where_their_poses_say(sensor, serve, opened, snapshots):
    source = PassiveSource(tuple(ShownSensor(side, sensor) for side in ("left", "right")))
    page = serve(source)
    tab = opened(page)

    def distances() -> list[float]:
        """From what they hold to each gel, mm."""
        found = np.array(tab.tab.evaluate(PLACES)).reshape(-1, 4)
        is_held = found[:, 0] == 3 * len(TRIANGLES)
        if is_held.sum() != 1:
            return []
        away = np.linalg.norm(found[~is_held, 1:] - found[is_held, 1:], axis=1)
        return sorted({round(value, 2) for value in away.tolist()})

    for number, height in enumerate((0.0, 0.04)):
        for side, y in (("left", -0.01), ("right", 0.02)):
            mount, body = Pose((0.0, y, height)), Body(TRIANGLES, Pose((0.0, 0.0, height)))
            shown = replace(snapshots[-1], stamp_ns=number, mount=mount, body=body)
            page.show(side, shown)
        tab.wait(lambda: distances() == [10.0, 20.0], "the object between the fingers")
    tab.sees("left")
    assert not tab.console


class Controlled(PassiveSource):
    """A source with buttons, and an indenter."""

    def __init__(self, sensors):
        super().__init__(sensors)
        self.pressed = 0
        self.moves = []
        self.touch = Touch(self.moves.append, Pose((0.0, 0.0, 0.002)))

    def actions(self):
        return {
            self.sensors[0].name: (
                Action(BUTTON, "adds one", self._press),
                Action("fail", "never works", self._fail),
            )
        }

    def touches(self):
        return {self.sensors[0].name: self.touch}

    def settings(self, _sensor):
        return tuple(
            Setting(owner, f"{owner}'s rate", 1.0, "", lambda value: f"is now {value}")
            for owner in ("tracker", "visualizer")
        )

    def _press(self):
        self.pressed += 1
        return f"pressed {self.pressed} times"

    def _fail(self):
        msg = "the service is not there"
        raise CmpTactileError(msg)


@pytest.fixture
def controlled(sensor):
    return Controlled((ShownSensor("thumb", sensor),))


def test_a_button_does_it_and_its_answer_appears(controlled, serve, opened):
    tab = opened(serve(controlled))
    tab.tab.get_by_text(BUTTON, exact=True).click()
    tab.sees("pressed 1 times")
    tab.tab.get_by_text("fail", exact=True).click()
    tab.sees("the service is not there")
    assert controlled.pressed == 1


def test_parameters_are_in_a_folder_of_their_node(controlled, serve, opened):
    tab = opened(serve(controlled))
    tab.sees("adds one")
    tab.tab.get_by_text("parameters", exact=True).first.click()
    tab.sees("2 that may change")
    rate = tab.tab.get_by_text("tracker's rate", exact=True)
    assert not rate.is_visible()
    tab.tab.get_by_text("tracker", exact=True).click()
    tab.wait(rate.is_visible, "the parameters of the tracker")
    assert not tab.tab.get_by_text("visualizer's rate", exact=True).is_visible()


def test_a_page_to_read_has_no_buttons(controlled, serve, opened):
    tab = opened(serve(controlled, read_only=True))
    tab.sees("surface at rest")
    assert tab.tab.get_by_text(BUTTON, exact=True).count() == 0


def test_the_mouse_drags_the_indenter(controlled, serve, opened, snapshots):
    """Along the axis of the handle that is under the mouse, from where the indenter is."""
    page = serve(controlled)
    page.show("thumb", snapshots[0])
    tab = opened(page)
    tab.wait(lambda: tab.meshes()[0] > 0, "the surface")
    tab.tab.wait_for_timeout(500)
    # Along the upright axis, 4 mm long, of the indenter that stands 2 mm above the middle.
    along = [tab.pixel(0.0, 0.0, 2.0 + share * 4.0) for share in (0.7, 0.5, 0.9, 0.3)]
    mouse = tab.tab.mouse

    def drag() -> bool:
        for x, y in along:
            mouse.move(x, y)
            mouse.down()
            mouse.move(x, y + 40, steps=2)
            mouse.up()
            # The first may come before the mouse has moved.
            if controlled.moves and controlled.moves[-1].position[2] != pytest.approx(0.002):
                return True
            tab.tab.get_by_text("fit", exact=True).click()
        return False

    tab.wait(drag, "a move of the indenter")
    x, y, z = controlled.moves[-1].position
    assert (x, y) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert z < 0.002


def test_the_slider_seeks_and_the_end_is_said(grasp_bag, sensor, serve, opened):
    recording = open_source(grasp_bag, sensor)
    recording.playback.playing = recording.playback.loop = False
    tab = opened(serve(recording))
    tab.sees("paused")
    slider = tab.tab.locator(".mantine-Slider-thumb").first

    def at_the_end():
        # A page that is still being built may miss a key.
        slider.press("End")
        return recording.playback.position_s > recording.playback.length_s - 0.1

    tab.wait(at_the_end, "the last frame")
    tab.tab.get_by_text("play", exact=True).click()
    tab.sees("at the end")
