"""What RViz makes of its settings and of texts: where each point and each word is on the screen.

After RViz's sources: OrbitViewController, TextViewFacingMarker, MovableText, and Qt's restoreState.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.textpath import TextPath
from numpy.typing import NDArray

from cmp_tactile_processing.ros.rviz import DrawnMarker

SETTINGS = Path(__file__).parents[2] / "cmp_tactile_bringup" / "rviz"
# RViz's camera sees 45 degrees of height.
FIELD_OF_VIEW = np.radians(45)
# What the window has beside docks and picture, px: menu, tools and status above and below, and the
# two buttons that hide the docks.
BARS_PX, BUTTONS_PX, SEPARATOR_PX = 92, 32, 6
# A letter of RViz is as high as its font's lines.
EM_PER_HEIGHT = 1 / 1.15
# RViz's text: a space is half of scale.x wide, and where that is 0, half of its letter A in a text
# of 1 m; lines are a letter and 5 mm apart, whatever the size.
WIDTH_OF_A, LINE_GAP_M = 0.67, 5e-3
TABS, SEQUENCE, WIDGET = 0xFA, 0xFC, 0xFB

Float = NDArray[np.float64]


def read_settings(name: str) -> dict[str, Any]:
    """Packaged settings, by the name of their file."""
    settings: dict[str, Any] = yaml.safe_load((SETTINGS / name).read_text(encoding="utf-8"))
    return settings


def picture_px(settings: Mapping[str, Any]) -> tuple[int, int]:
    """Width and height of the picture between the docks of the window, px."""
    window = settings["Window Geometry"]
    docks = dock_widths(bytes.fromhex(window["QMainWindow State"]))
    beside = sum(width + SEPARATOR_PX for width in docks) + BUTTONS_PX
    return window["Width"] - beside, window["Height"] - BARS_PX


@dataclass
class _State:
    """Qt's QDataStream of a main window's state, big endian."""

    data: bytes
    place: int = 0

    def take(self, form: str) -> tuple[int, ...]:
        size = struct.calcsize(">" + form)
        found = struct.unpack(">" + form, self.data[self.place : self.place + size])
        self.place += size
        return found

    def area(self) -> Iterator[str]:
        """The names of the docks in one."""
        marker = self.take("B")[0]
        if marker == TABS:
            self.take("i")
        elif marker != SEQUENCE:
            msg = f"found {marker:#x} in the state of the window, expected a sequence"
            raise ValueError(msg)
        _, count = self.take("Bi")
        for _ in range(count):
            if self.take("B")[0] == WIDGET:
                (length,) = self.take("i")
                yield self.data[self.place : self.place + length].decode("utf-16-be")
                self.place += length
                self.take("B4i")
            else:
                self.take("4i")
                yield from self.area()


def dock_widths(state: bytes) -> list[int]:
    """The widths of the left and right dock of a window, px."""
    stream = _State(state)
    stream.take("iiB")
    widths = []
    for _ in range(stream.take("i")[0]):
        _, width, _ = stream.take("3i")
        widths.append(width)
        list(stream.area())
    return widths


@dataclass(frozen=True)
class View:
    """RViz's orbit: the camera's place (3,) in the fixed frame, and right, up, back as rows.

    height_px: of the picture.
    """

    camera: Float
    axes: Float
    height_px: float

    @classmethod
    def of(cls, view: Mapping[str, Any], height_px: float, target: Float | None = None) -> View:
        """A view of the settings; target (3,): origin of its target frame in the fixed frame.

        RViz's orbit follows the place of its frame, not how that is turned.
        """
        yaw, pitch = view["Yaw"], view["Pitch"]
        back = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        right = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        focus = np.array([view["Focal Point"][axis] for axis in "XYZ"], np.float64)
        focus += np.zeros(3) if target is None else target
        axes = np.stack([right, np.cross(back, right), back])
        return cls(focus + view["Distance"] * back, axes, height_px)

    def project(self, points: Float) -> tuple[Float, Float, Float]:
        """Points (..., 3) m: px from the middle (..., 2), y up; px per m there; depth, m."""
        across = (points - self.camera) @ self.axes.T
        depth = -across[..., 2]
        scale = self.height_px / 2 / np.tan(FIELD_OF_VIEW / 2) / depth
        return across[..., :2] * scale[..., None], scale, depth


def placed_words(marker: DrawnMarker) -> list[tuple[str, float, float]]:
    """The words of a text, with left and top of each beside the marker's position, m."""
    size, space = marker.scale[2], marker.scale[0] / 2 or WIDTH_OF_A
    rows = [line.split(" ") for line in marker.text.split("\n")]
    widths = [[_width(word, size) for word in row] for row in rows]
    widest = max(sum(row) + space * (len(row) - 1) for row in widths)
    height = len(rows) * size + (len(rows) - 1) * LINE_GAP_M
    return [
        (
            word,
            -widest / 2 + sum(row[:before]) + before * space,
            height / 2 - k * (size + LINE_GAP_M),
        )
        for k, (words, row) in enumerate(zip(rows, widths, strict=True))
        for before, word in enumerate(words)
    ]


def text_box(marker: DrawnMarker, view: View) -> tuple[Float, Float]:
    """Lower left and upper right of a text on the screen, px from the middle, y up."""
    (middle, scale, _) = view.project(np.array(marker.position))
    words = placed_words(marker)
    size = marker.scale[2]
    left, top = (f(word[k] for word in words) for f, k in ((min, 1), (max, 2)))
    right = max(word[1] + _width(word[0], size) for word in words)
    bottom = min(word[2] for word in words) - size
    return middle + scale * np.array([left, bottom]), middle + scale * np.array([right, top])


def _width(word: str, size: float) -> float:
    return _width_in_letters(word) * size if word else 0.0


@cache
def _width_in_letters(word: str) -> float:
    return float(TextPath((0, 0), word, size=EM_PER_HEIGHT).get_extents().width)
