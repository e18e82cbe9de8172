"""The panels beside the scene: what is shown, health, buttons, parameters, playback."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import viser

from cmp_tactile_processing.errors import CmpTactileError, Finding, Severity
from cmp_tactile_processing.surface.reference_keeping import DOUBTFUL
from cmp_tactile_viewer.meshes import band_colours
from cmp_tactile_viewer.page.scene import ARROWS, COLOURS, PRESETS, UNITS, Look
from cmp_tactile_viewer.snapshot import Action, Playback, Setting

# Sign and colour: the signs differ, for who does not see the colours.
SIGNS = {
    Severity.OK: ("&#10003;", "#00795a"),
    Severity.WARNING: ("!", "#a05a00"),
    Severity.ERROR: ("&#10007;", "#b00020"),
}
TIME_STEP_S = 0.01
SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
BUTTONS_IN_ROW = 3
# An answer has its place before it comes, so that what is below stays where it is.
# Four lines of SMALL.
ANSWER = '<div style="height:4.59em;overflow-y:auto">{}</div>'
SMALL = "font-size:0.85em;line-height:1.35;padding:0 0.6em;overflow-wrap:anywhere"
HANGING = "padding-left:1em;text-indent:-1em"


class ShowPanel:
    """What is drawn, by whoever looks; all browsers see the same."""

    def __init__(
        self, gui: viser.GuiApi, views: Sequence[str], aim: Callable[[str, Any], None]
    ) -> None:
        """aim: called with the name of a camera preset and the client that asked for it."""
        buttons = gui.add_button_group("camera", PRESETS)
        buttons.on_click(lambda event: aim(event.target.value, event.client))
        self._colour = gui.add_dropdown(
            "colour", COLOURS, hint="Quantity shown by the surface's colour"
        )
        self._legend = gui.add_html("")
        self._arrows = gui.add_dropdown("arrows", ARROWS)
        self._gain = gui.add_slider(
            "arrow length", 0.1, 10.0, 0.1, 1.0, hint="1: a contact force of 1 N is drawn 1 mm long"
        )
        self._at_rest = gui.add_checkbox("surface at rest", True)
        self._contacts = gui.add_checkbox(
            "contacts", True, hint="Outline, force with error, moment"
        )
        self._texts = gui.add_checkbox("texts", True)
        self._view = gui.add_dropdown("image", (*views, "none"))
        self._gridlines = gui.add_checkbox("gridlines", True)
        self._shown = ("", 0.0)

    def on_change(self, call: Callable[[], None]) -> None:
        """Call when any of it has changed."""
        for handle in (
            self._colour, self._arrows, self._gain, self._at_rest, self._contacts, self._texts,
            self._view, self._gridlines,
        ):  # fmt: skip
            handle.on_update(lambda _: call())

    @property
    def look(self) -> Look:
        """What is chosen for the scene."""
        return Look(
            self._colour.value,
            self._arrows.value,
            self._gain.value,
            self._at_rest.value,
            self._contacts.value,
            self._texts.value,
        )

    @property
    def image(self) -> tuple[str, bool]:
        """Which views, "none" for no image, and whether gridlines are drawn into them."""
        return self._view.value, self._gridlines.value

    def show_range(self, top: float) -> None:
        """Show where the colours end, in SI units."""
        if (self._colour.value, top) != self._shown:
            self._shown = (self._colour.value, top)
            self._legend.content = _legend(*self._shown)


def _legend(colour: str, top: float) -> str:
    if colour not in UNITS:
        return ""
    factor, unit = UNITS[colour]
    stops = [f"rgb({r},{g},{b})" for r, g, b in band_colours().tolist()]
    return (
        f'<div style="{SMALL};display:flex;gap:0.5em;align-items:center"><span>0</span>'
        f'<span style="flex:1;height:0.8em;background:linear-gradient(to right,{",".join(stops)})">'
        f"</span><span>{top * factor:g} {unit}</span></div>"
    )


def health_html(lines: Iterable[Finding]) -> str:
    """A list, the worst first; texts are shown as they are, never taken as HTML."""
    items = []
    for line in sorted(lines, key=lambda item: -item.severity):
        sign, colour = SIGNS[line.severity]
        about, text = html.escape(line.about), html.escape(line.text)
        items.append(
            f'<div style="{HANGING}"><b style="color:{colour}">{sign} {about}:</b> {text}</div>'
        )
    return f'<div style="{SMALL}">{"".join(items) or "nothing to report yet"}</div>'


class ControlPanel:
    """Buttons and parameters of one sensor, and what the last of them answered."""

    def __init__(
        self,
        gui: viser.GuiApi,
        actions: Sequence[Action],
        settings: Callable[[], Sequence[Setting]],
    ) -> None:
        self._gui, self._settings = gui, settings
        at_once = [action for action in actions if action.state is None]
        known = (
            *at_once,
            Action("parameters", "Parameters that may change now", self._show_settings),
        )
        for first in range(0, len(known), BUTTONS_IN_ROW):
            row = {action.label: action for action in known[first : first + BUTTONS_IN_ROW]}
            group = gui.add_button_group("", tuple(row))
            group.on_click(partial(self._pressed, row))
        self._lasting = [
            _LastingButton(gui, action, self._press) for action in actions if action.state
        ]
        # A tooltip would cover the buttons, of which a row has one in common.
        hints = "".join(
            f'<div style="{HANGING}"><b>{action.label}:</b> {action.hint}</div>' for action in known
        )
        self._answer = gui.add_html(ANSWER.format(f'<div style="{SMALL}">{hints}</div>'))
        self._folder = gui.add_folder("parameters", visible=False)
        self._handles: list[Any] = []

    def show(self) -> None:
        """Show what goes on."""
        for button in self._lasting:
            button.show()

    def _pressed(self, row: Mapping[str, Action], event: viser.GuiEvent[Any]) -> None:
        action = row[event.target.value]
        self._press(action.label, action.run, event)

    def _show_settings(self) -> str:
        found = self._settings()
        for handle in self._handles:
            handle.remove()
        groups: dict[str, list[Setting]] = {}
        for setting in found:
            groups.setdefault(setting.owner, []).append(setting)
        self._handles = []
        for owner, settings in groups.items():
            with self._folder:
                folder = self._gui.add_folder(owner, expand_by_default=False)
            self._handles.append(folder)
            with folder:
                for setting in settings:
                    self._add(self._gui, setting)
        self._folder.visible = bool(found)
        return f"{len(found)} that may change"

    def _add(self, gui: viser.GuiApi, setting: Setting) -> None:
        value, hint = setting.value, setting.description
        handle: Any
        if setting.choices:
            handle = gui.add_dropdown(
                setting.name, setting.choices, initial_value=str(value), hint=hint
            )
        elif isinstance(value, bool):
            handle = gui.add_checkbox(setting.name, value, hint=hint)
        elif isinstance(value, (int, float)):
            handle = gui.add_number(
                setting.name, value, min=setting.low, max=setting.high, hint=hint
            )
        else:
            handle = gui.add_text(setting.name, value, hint=hint)
        handle.on_update(partial(self._change, setting))

    def _change(self, setting: Setting, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:
            self._press(
                f"{setting.owner}.{setting.name}", lambda: setting.change(event.target.value), event
            )

    def _press(self, label: str, run: Callable[[], str], _event: object) -> None:
        self._say(Severity.OK, label, "...")
        try:
            said = run()
            self._say(Severity.WARNING if DOUBTFUL in said else Severity.OK, label, said)
        except CmpTactileError as error:
            self._say(Severity.ERROR, label, str(error))

    def _say(self, severity: Severity, label: str, text: str) -> None:
        self._answer.content = ANSWER.format(health_html([Finding(severity, text, about=label)]))


class _LastingButton:
    """A button of what goes on until it is pressed again: red while it does, and says so."""

    def __init__(
        self,
        gui: viser.GuiApi,
        action: Action,
        press: Callable[[str, Callable[[], str], object], None],
    ) -> None:
        self._action = action
        self._button = gui.add_button(action.label, hint=action.hint)
        self._button.on_click(partial(press, action.label, action.run))

    def show(self) -> None:
        """Show whether it goes on."""
        state = self._action.state() if self._action.state is not None else ""
        label = state or self._action.label
        if label != self._button.label:
            self._button.label, self._button.color = label, "red" if state else None


class PlaybackPanel:
    """Slider, play, steps and speed of a recording."""

    def __init__(self, gui: viser.GuiApi, playback: Playback, wake: Callable[[], None]) -> None:
        self._playback, self._wake = playback, wake
        end = max(math.ceil(playback.length_s / TIME_STEP_S) * TIME_STEP_S, TIME_STEP_S)
        self._time: Any = gui.add_slider("time, s", 0.0, round(end, 2), TIME_STEP_S, 0.0)
        self._time.on_update(self._seek)
        self._play = gui.add_button("pause")
        self._play.on_click(lambda _: self._toggle())
        steps = gui.add_button_group("step", ("back", "forward"))
        steps.on_click(lambda event: self._step(-1 if event.target.value == "back" else 1))
        self._speed = gui.add_dropdown("speed", SPEEDS, initial_value="1")
        self._speed.on_update(lambda _: setattr(playback, "speed", float(self._speed.value)))
        self._loop = gui.add_checkbox("loop", playback.loop, hint="Repeat from the beginning")
        self._loop.on_update(lambda _: setattr(playback, "loop", self._loop.value))
        self._state = gui.add_html("")

    def show(self) -> None:
        """Show where the recording is."""
        playback = self._playback
        if playback.seek_s is None:
            self._time.value = round(min(playback.position_s, self._time.max), 2)
        running = playback.playing
        self._play.label = "pause" if running else "play"
        state = "at the end" if playback.ended else "playing" if running else "paused"
        place = f"{playback.position_s:.2f} of {playback.length_s:.2f} s, {state}"
        shown = "preparing the first picture" if playback.preparing else place
        self._state.content = f'<div style="{SMALL}">{shown}</div>'

    def _seek(self, event: viser.GuiEvent[Any]) -> None:
        # The page moves the slider, too.
        if event.client is not None:
            # The slider's last step lies behind the last frame.
            self._playback.seek_s = min(float(self._time.value), self._playback.length_s)
            self._wake()

    def _toggle(self) -> None:
        playback = self._playback
        if playback.ended:
            playback.seek_s, playback.playing = 0.0, True
        else:
            playback.playing = not playback.playing
        self._wake()

    def _step(self, frames: int) -> None:
        self._playback.playing = False
        self._playback.steps += frames
        self._wake()
