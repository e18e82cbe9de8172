"""Joins it all: takes snapshots, draws the newest of each sensor, and asks the source for more."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import viser

from cmp_tactile_processing.errors import Finding
from cmp_tactile_viewer.page import camera_image
from cmp_tactile_viewer.page.layout import (
    BEAT_S,
    LEFT_OF_SEVERAL_PX,
    LEFT_PX,
    PANEL_PX,
    STYLE,
    beat_html,
    health_box,
)
from cmp_tactile_viewer.page.panels import ControlPanel, PlaybackPanel, ShowPanel, health_html
from cmp_tactile_viewer.page.plots import History, Plots
from cmp_tactile_viewer.page.scene import (
    HOUSING_COLOURS,
    LEAST_RANGE,
    Aim,
    DraggedIndenter,
    Framing,
    Gel,
    HeldBody,
    Look,
)
from cmp_tactile_viewer.page.server import Access, PageServer
from cmp_tactile_viewer.snapshot import ShownSensor, Snapshot, Source

# Pictures of the scene a second, of the camera, and of plots, clocks and health, which are read.
RATE_HZ, IMAGE_HZ, SLOW_HZ = 30.0, 10.0, 5.0
PLOT_LENGTHS = ("5", "20", "60")
NO_IMAGE = np.zeros((48, 64, 3), np.uint8)
# Height of the plot of forces: of one sensor, and of each of several.
PLOT_PX, PLOT_OF_SEVERAL_PX = 160, 110
JPEG_QUALITY = 80
# Share of the period that has to lie between two pictures.
MOST_HASTE = 0.5
# Of the light from all sides, and its colour from below.
LIGHT, GROUND = 2.0, (190, 190, 190)


@dataclass
class _Cadence:
    """Of what is drawn less often.  due_s: when what waits is drawn, None where nothing waits."""

    period_s: float
    due_s: float | None = None
    _last_s: float = 0.0

    def has_turn(self, now_s: float) -> bool:
        """Whether it is time; else it waits."""
        next_s = self._last_s + self.period_s
        if now_s < next_s:
            self.due_s = next_s
            return False
        self.due_s, self._last_s = None, now_s
        return True


@dataclass
class _Shown:
    """What belongs to one sensor."""

    gel: Gel
    image: Any
    plots: Plots
    indenter: DraggedIndenter | None
    history: History = field(default_factory=History)
    newest: Snapshot | None = None
    drawn: Snapshot | None = None
    # With an image: the newest, and the one on show.
    imaged: Snapshot | None = None
    pictured: Snapshot | None = None


class Page:
    """Serves a page and keeps it up to date while somebody looks; a thread of its own draws.

    The source is started with the first browser that looks, and paused when the last one leaves.
    """

    def __init__(self, source: Source, access: Access, rate_hz: float = RATE_HZ) -> None:
        """Raises CmpTactileError where the address cannot be listened on."""
        self._source, self._period_s = source, 1 / rate_hz
        self._server = PageServer(access, "cmp_tactile")
        self._wake, self._ended = threading.Event(), False
        self._changed = False
        self._image, self._slow = _Cadence(1 / IMAGE_HZ), _Cadence(1 / SLOW_HZ)
        self._health: list[Finding] = []
        self._beat, self._beat_s = 0, 0.0
        self._viewers = 0
        self._aims: dict[int, Aim] = {}
        self._guard = threading.Lock()
        self.pictures = 0
        self._build(access)
        self._server.on_client_connect(self._come)
        self._server.on_client_disconnect(self._leave)
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """The address to open in a browser."""
        return self._server.url

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.get_port())

    @property
    def viewers(self) -> int:
        """How many browsers look."""
        return self._viewers

    def show(self, sensor: str, snapshot: Snapshot) -> None:
        """Draw it as soon as there is time; a newer one takes its place.

        Raises KeyError for a sensor that the source has not.
        """
        shown = self._sensors[sensor]
        with self._guard:
            shown.history.add(snapshot)
            shown.newest = snapshot
            if snapshot.has_image:
                shown.imaged = snapshot
        self._wake.set()

    def show_health(self, lines: list[Finding]) -> None:
        """Replace the list of what is the matter."""
        self._health = lines
        self._wake.set()

    def close(self) -> None:
        """End the page; browsers look for it again until it is back."""
        self._ended = True
        self._wake.set()
        self._thread.join()
        self._source.close()
        self._server.stop()

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _build(self, access: Access) -> None:
        server, gui, source = self._server, self._server.gui, self._source
        gui.configure_theme(show_logo=False, show_share_button=False)
        server.scene.set_up_direction("+z")
        # With shadows and reflections, software draws a quarter of the pictures.
        server.scene.configure_default_lights(cast_shadow=False)
        server.scene.configure_environment_map(None)
        server.scene.add_light_hemisphere("/light", ground_color=GROUND, intensity=LIGHT)
        self._sensors = {
            sensor.name: self._add_sensor(sensor, number)
            for number, sensor in enumerate(source.sensors)
        }
        self._body = HeldBody(server.scene)
        dragged = {
            name
            for name, touch in source.touches().items()
            if touch.move is not None and not access.read_only
        }
        self._framing = Framing(source.sensors, dragged)
        gui.add_html(STYLE)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PX)
        self._playback: PlaybackPanel | None = None
        if source.playback is not None:
            with gui.add_folder("recording"):
                self._playback = PlaybackPanel(gui, source.playback, self._wake.set)
        with gui.add_folder("health"):
            self._health_list = gui.add_html(health_box(health_html([])))
            self._alive = gui.add_html(beat_html(0))
        self._controls: list[ControlPanel] = []
        if not access.read_only:
            self._add_controls()
        with gui.add_folder("show"):
            self._panel = ShowPanel(gui, camera_image.VIEWS, self._aim)
            self._panel.on_change(self._look_changed)
        with gui.add_folder("plots"):
            self._length = gui.add_dropdown("seconds", PLOT_LENGTHS, initial_value=PLOT_LENGTHS[1])
            self._hold = gui.add_checkbox(
                "hold", False, hint="Stop the plots so that you can scroll back"
            )
            self._back = gui.add_slider("back, s", 0.0, 120.0, 0.5, 0.0)
            for handle in (self._length, self._hold, self._back):
                handle.on_update(lambda _: self._look_changed())

    def _add_controls(self) -> None:
        gui = self._server.gui
        for name, actions in self._source.actions().items():
            with gui.add_folder(name):
                panel = ControlPanel(gui, actions, partial(self._source.settings, name))
            self._controls.append(panel)

    def _add_sensor(self, sensor: ShownSensor, number: int) -> _Shown:
        gui, several = self._server.gui, len(self._source.sensors) > 1
        colour = HOUSING_COLOURS[number % len(HOUSING_COLOURS)] if several else None
        gel = Gel(self._server.scene, sensor, colour)
        panel = gui.add_panel()
        with panel.add_tab(f"{sensor.name}: view"):
            image = gui.add_image(NO_IMAGE, format="jpeg", jpeg_quality=JPEG_QUALITY)
            plots = Plots(
                gui,
                PLOT_OF_SEVERAL_PX if several else PLOT_PX,
                is_live=self._source.playback is None,
            )
        if number == 0:
            panel.dock_left()
            panel.set_width(LEFT_OF_SEVERAL_PX if several else LEFT_PX)
            self._first_panel = panel
        else:
            panel.dock_below(self._first_panel)
        touch = self._source.touches().get(sensor.name)
        may_move = not self._server.access.read_only
        indenter = (
            None
            if touch is None
            else DraggedIndenter(
                self._server.scene, f"/{sensor.name}/touch", touch, may_move=may_move
            )
        )
        return _Shown(gel, image, plots, indenter)

    def _aim(self, preset: str, client: viser.ClientHandle | None) -> None:
        """Turn the camera of the browser that asks for it."""
        aim = None if client is None else self._aims.get(client.client_id)
        if aim is not None:
            aim.take(preset)

    def _come(self, client: viser.ClientHandle) -> None:
        self._aims[client.client_id] = Aim(client, self._framing)
        with self._guard:
            self._viewers += 1
            first = self._viewers == 1
        if first:
            self._source.start(self)
        self._look_changed()

    def _leave(self, client: viser.ClientHandle) -> None:
        self._aims.pop(client.client_id, None)
        with self._guard:
            self._viewers -= 1
            last = self._viewers == 0
        if last:
            self._source.pause()

    def _look_changed(self) -> None:
        self._changed = True
        self._wake.set()

    def _run(self) -> None:
        next_s = 0.0
        while True:
            # What is drawn seldom is drawn once more where nothing follows.
            due = [item.due_s for item in (self._image, self._slow) if item.due_s is not None]
            wait_s = max(0.0, min(due) - time.monotonic()) if due else BEAT_S
            self._wake.wait(wait_s if self._viewers else None)
            self._wake.clear()
            if self._ended:
                return
            begin = time.monotonic()
            if self._viewers:
                self._draw(begin)
            else:
                self._image.due_s = self._slow.due_s = None
            # In step with a source of the same rate: a late picture is not made up for by the next.
            next_s = max(next_s + self._period_s, begin + MOST_HASTE * self._period_s)
            time.sleep(max(0.0, next_s - time.monotonic()))

    def _draw(self, now_s: float) -> None:
        changed, self._changed = self._changed, False
        look = self._panel.look
        if changed:
            for shown in self._sensors.values():
                shown.gel.range.start(look.colour, LEAST_RANGE.get(look.colour, 1.0))
        with self._server.atomic():
            has_moved = self._draw_scene(changed, look)
            if self._image.has_turn(now_s) or changed:
                for shown in self._sensors.values():
                    if shown.imaged is not shown.pictured or changed:
                        self._draw_image(shown)
            if self._slow.has_turn(now_s) or changed:
                self._draw_slow(now_s, changed)
        for aim in [*self._aims.values()] if has_moved else ():
            aim.follow()

    def _draw_scene(self, changed: bool, look: Look) -> bool:
        """Draw the newest of each sensor; whether one has left what the camera frames."""
        has_moved = False
        for name, shown in self._sensors.items():
            snapshot = shown.newest
            if snapshot is None or (snapshot is shown.drawn and not changed):
                continue
            shown.gel.draw(snapshot, look)
            self._body.draw(snapshot.body)
            if snapshot.mount is not None:
                has_moved |= self._framing.follow(name, snapshot.mount)
            if shown.indenter is not None:
                shown.indenter.draw()
            shown.drawn = snapshot
            self.pictures += 1
        return has_moved

    def _draw_slow(self, now_s: float, changed: bool) -> None:
        self._panel.show_range(max(shown.gel.range.top for shown in self._sensors.values()))
        hold, back_s = self._hold.value, self._back.value
        for shown in self._sensors.values():
            if not hold or changed:
                with self._guard:
                    shown.plots.draw(shown.history, float(self._length.value), back_s)
        if self._playback is not None:
            self._playback.show()
        for panel in self._controls:
            panel.show()
        health = health_box(health_html(self._health))
        # A list that is not set anew stays where it is scrolled to.
        if health != self._health_list.content:
            self._health_list.content = health
        if now_s - self._beat_s >= BEAT_S:
            self._beat_s, self._beat = now_s, self._beat + 1
            self._alive.content = beat_html(self._beat)

    def _draw_image(self, shown: _Shown) -> None:
        snapshot, (views, gridlines) = shown.imaged, self._panel.image
        picture = None if snapshot is None else camera_image.picture(snapshot, views, gridlines)
        shown.image.visible = picture is not None
        if picture is not None:
            shown.image.image = picture
        shown.pictured = snapshot
