"""Numbers of corners in drawn views: right, or missing with the fault named.

The views are drawn from true corners, the graphs made from them, so nothing here rests on a
detector.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.sensor.parts import (
    Camera,
    ImageSize,
    Optics,
    PatternSurface,
    Roi,
    ViewDescription,
)
from cmp_tactile_processing.tracking.detector import (
    LIGHT,
    STEPS,
    CornerGraph,
    NominalGrid,
    draw_nominal,
)
from cmp_tactile_processing.tracking.numbering.whole_view import GridNumbering

from .conftest import prepared

# A corner farther than this from its true place bears a wrong number or is none, in sides.
WRONG = 0.5
# Detected positions: standard deviation of each coordinate, px.
DETECTED_PX = 0.4


@dataclass
class Rig:
    """One view of a sensor: draws its pattern, makes graphs of it, numbers them."""

    sensor: object
    view: str = "left"

    def __post_init__(self):
        self.geometry = build_views(self.sensor)[self.view]
        place = self.geometry.placement
        nominal = NominalGrid.of_view(self.sensor.pattern, self.geometry)
        self.window = nominal.window(place.width, place.height)
        self.nominal = nominal.seen_through(self.window)
        self.size = self.nominal.corners.shape[:2]
        self.dark_first = self.sensor.pattern.corner_checker == "dark"
        self.numbering = GridNumbering(self.nominal, self.dark_first)

    def outline(self, shift=(0.0, 0.0), bump=0.0, size=None):
        """Corners of all checkers, (rows + 2, cols + 2, 2) px, the pattern moved by whole sides.

        bump: sides by which the gel is dragged, most at the centre.
        """
        rows, cols = size or self.size
        i, j = np.mgrid[-1 : rows + 1, -1 : cols + 1].astype(float)
        away = ((i - rows / 2) / rows) ** 2 + ((j - cols / 2) / cols) ** 2
        drag = bump * np.exp(-away / 0.1)
        i += (self.size[0] - rows) / 2 + shift[0] + 0.6 * drag
        j += (self.size[1] - cols) / 2 + shift[1] - 0.8 * drag
        return self.geometry.project(self.sensor.pattern.at(i, j)) - self.window.origin

    def draw(self, outline):
        """The view (H, W) uint8 without noise."""
        seen = replace(self.nominal, corners=outline[1:-1, 1:-1])
        return draw_nominal(seen, (self.window.height, self.window.width), self.dark_first)

    def graph(self, outline, visible=None):
        """Graph of the corners that are visible (rows, cols)."""
        corners = outline[1:-1, 1:-1]
        visible = np.ones(corners.shape[:2], bool) if visible is None else visible
        index = np.full(np.add(visible.shape, 2), -1)
        i, j = np.nonzero(visible)
        index[i + 1, j + 1] = np.arange(len(i))
        neighbour = np.stack([index[i + 1 + a, j + 1 + b] for a, b in STEPS], axis=1)
        noise = np.random.default_rng(0).normal(0, DETECTED_PX, (len(i), 2))
        even = ((i + j) % 2 == 0) == self.dark_first
        return CornerGraph(corners[i, j] + noise, np.ones(len(i), bool), even, neighbour)

    def number(self, outline, image=None, hidden=None, previous=None):
        """Numbers the corners that a mask (H, W) leaves in sight; image: by default as drawn."""
        image = self.draw(outline) if image is None else image
        visible = None if hidden is None else self.visible(hidden, outline)
        return self.numbering.number(self.graph(outline, visible), prepared(image), previous)

    def visible(self, hidden, outline):
        return clear_of(hidden, outline, 0.4 * self.nominal.side_px)

    def wrong(self, found, outline):
        apart = np.linalg.norm(found.corners - outline[1:-1, 1:-1], axis=-1)
        return int((apart > WRONG * self.nominal.side_px).sum())


def filled(polygon, shape):
    """Mask of a polygon (n, 2) px."""
    mask = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [np.rint(polygon).astype(np.int32)], 1)
    return mask > 0


def assert_refused(found, fault, reason=""):
    assert np.isnan(found.corners).all()
    assert found.fault is fault
    assert reason in found.reason


def share_of(outline, side, share, shape):
    """Mask of the left, right, top or bottom share of the pattern in the image."""
    low, high = outline.reshape(-1, 2).min(axis=0), outline.reshape(-1, 2).max(axis=0)
    y, x = np.indices(shape)
    u, v = (x - low[0]) / (high[0] - low[0]), (y - low[1]) / (high[1] - low[1])
    places = {"left": u, "right": 1 - u, "top": v, "bottom": 1 - v}
    return places[side] < share


def clear_of(mask, outline, distance_px):
    """Which corners (rows, cols) lie that far from what a mask hides."""
    distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    x, y = np.rint(outline[1:-1, 1:-1]).astype(int).transpose(2, 0, 1)
    inside = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
    limit = mask.shape[1] - 1, mask.shape[0] - 1
    return inside & (distance[y.clip(0, limit[1]), x.clip(0, limit[0])] > distance_px)


@pytest.fixture(scope="module")
def rig(sensor):
    return Rig(sensor)


@pytest.fixture(scope="module")
def hidden_view(rig):
    """Draws a moved pattern, hides a mask, numbers it; returns the numbering and its truth."""
    drawn = lru_cache(maxsize=None)(lambda shift: rig.draw(rig.outline(shift)))

    def number(shift, sides, share=1 / 3, grey=110.0, previous=None):
        outline, image = rig.outline(shift), drawn(shift).copy()
        mask = np.zeros(image.shape, bool)
        for side in sides:
            mask |= share_of(rig.outline(), side, share, image.shape)
        image[mask] = grey
        found = rig.number(outline, image, mask, previous)
        far = clear_of(mask, outline, 2 * rig.nominal.side_px)
        return found, outline, far

    return number


# As far as a lattice may be moved, and by one checker, to one of the same colour and of the other.
SHIFTS = [*product((-2, 0, 2), repeat=2), (1, 1), (-1, 1), (1, 0), (0, -1)]


@pytest.mark.parametrize("shift", SHIFTS)
def test_alias_guard(hidden_view, rig, shift):
    """A lattice moved by whole checkers looks perfect to any local check: right or absent."""
    shift = (float(shift[0]), float(shift[1]))
    found, outline, in_image = hidden_view(shift, ())
    np.testing.assert_array_equal(np.isfinite(found.corners[..., 0]), in_image)
    assert rig.wrong(found, outline) == 0
    hidden = [("left",), ("right",), ("top",), ("bottom",), ("left", "right"), ("top", "bottom")]
    for number, (sides, share) in enumerate(product(hidden, (0.13, 0.3))):
        previous = rig.nominal.corners if number % 2 else None
        found, outline, _ = hidden_view(shift, sides, share, previous=previous)
        assert rig.wrong(found, outline) == 0, (sides, share)
        assert np.isfinite(found.corners).all() == (found.fault is GridFault.NONE)


@pytest.mark.parametrize("sides", [("left",), ("right",), ("top",), ("bottom",), ("left", "top")])
@pytest.mark.parametrize("grey", [15.0, 110.0, LIGHT])
def test_with_a_third_hidden_all_that_is_clear_of_it_is_numbered(hidden_view, rig, sides, grey):
    found, outline, far = hidden_view((0.4, -0.3), sides, grey=grey)
    assert rig.wrong(found, outline) == 0
    assert np.isfinite(found.corners[far]).all()
    assert found.fault is GridFault.PARTLY_HIDDEN
    # Rows or columns rest on one border, which something along a gridline could pretend.
    assert 0.2 < found.confidence <= 0.5


def test_without_a_border_in_sight_nothing_is_numbered(hidden_view, rig):
    """At rest the nominal projection fits exactly; after a knock of two checkers it would too."""
    found, _, _ = hidden_view((0.0, 0.0), ("left", "right"))
    assert_refused(found, GridFault.AMBIGUOUS, "columns")
    assert found.confidence == 0
    # The last frame alone proves nothing: it fits the knocked grid.
    found, outline, _ = hidden_view((0.0, 2.0), ("left", "right"), previous=rig.nominal.corners)
    assert rig.wrong(found, outline) == 0


def lines_of(outline, side, count, shape):
    """Mask of `count` lines from a side, up to a gridline."""
    lines = outline if "row" in side else outline.swapaxes(0, 1)
    lines = lines[::-1] if "last" in side else lines
    edge, beyond = lines[count], lines[count] + 3 * (lines[0] - lines[count])
    along = edge[-1] - edge[0]
    quad = np.concatenate([edge, [edge[-1] + along, beyond[-1] + along]])
    return filled(np.concatenate([quad, [beyond[0] - along, edge[0] - along]]), shape)


# Of the image, for the left view.
OPPOSITE = {
    "first row": "top", "last row": "bottom", "first column": "left", "last column": "right"
}  # fmt: skip


@pytest.fixture(scope="module")
def false_border(rig):
    """A gel knocked by `knock` checkers, two of its lines and the opposite side covered.

    Returns its numbers and its truth.  At a knock of two the cover ends where the pattern ended.
    """

    def number(side, knock, previous=None, grey=LIGHT):
        way = {"first row": (-1, 0), "last row": (1, 0), "first column": (0, -1)}.get(side, (0, 1))
        outline = rig.outline((knock * way[0], knock * way[1]))
        image = rig.draw(outline)
        mask = lines_of(outline, side, 2, image.shape)
        image[mask] = grey
        hidden = share_of(rig.outline(), OPPOSITE[side], 0.22, image.shape)
        image[hidden] = 15
        return rig.number(outline, image, mask | hidden, previous), outline

    return number


@pytest.mark.parametrize("side", OPPOSITE)
def test_a_false_border_far_from_the_nominal_place_is_doubted(rig, false_border, side):
    """As bright as the margin, along a gridline: nothing but the nominal projection speaks."""
    found, outline = false_border(side, 0.0)
    assert rig.wrong(found, outline) == 0
    assert found.fault is GridFault.AMBIGUOUS
    assert "border and nominal projection" in found.reason


@pytest.mark.parametrize("side", OPPOSITE)
def test_a_false_border_like_the_margin_at_the_nominal_place_is_doubted(rig, false_border, side):
    """The image is that of a gel at rest with one side hidden: only the confidence can show it."""
    for previous in (None, rig.nominal.corners):
        found, outline = false_border(side, 2.0, previous)
        assert rig.wrong(found, outline) > 0
        assert 0 < found.confidence <= 0.5


@pytest.mark.parametrize("side", OPPOSITE)
def test_after_a_jump_one_border_is_no_proof(rig, false_border, side):
    """The gel was knocked before, and is at its place now: the numbers would jump by two."""
    before = false_border(side, 2.0)[1][1:-1, 1:-1]
    found, _ = false_border(side, 2.0, before)
    assert_refused(found, GridFault.AMBIGUOUS, "after a jump")


@pytest.fixture
def ringed(rig):
    """Visible corners: a ring of lost ones cuts 4 x 4 off in the middle of the grid."""
    visible = np.ones(rig.size, bool)
    visible[6:12, 6:12] = False
    visible[7:11, 7:11] = True
    return visible


@pytest.mark.parametrize(("off", "continues"), [(0.0, True), (0.7, False)])
def test_a_fragment_continues_its_surroundings_or_is_left_out(rig, ringed, off, continues):
    """The same fragment half a checker off is another pattern: it fits no number."""
    outline = rig.outline(bump=1.0)
    graph = rig.graph(outline, ringed)
    i, j = np.nonzero(ringed)
    inside = (i > 6) & (i < 11) & (j > 6) & (j < 11)
    shift = off * rig.nominal.col_step[10, 10]
    graph = replace(graph, position=graph.position + inside[:, None] * shift)
    found = rig.numbering.number(graph, prepared(rig.draw(outline)))
    assert rig.wrong(found, outline) == 0
    numbered = ringed.copy()
    numbered[7:11, 7:11] = continues
    np.testing.assert_array_equal(np.isfinite(found.corners[..., 0]), numbered)
    # All borders are in sight; what was joined without a gridline might still be wrong.
    assert (found.confidence < 1) == continues
    assert found.fault is GridFault.PARTLY_HIDDEN


@pytest.mark.parametrize("change", [(-2, 0), (-1, 0), (2, 0), (0, -3), (1, 1)])
def test_another_size_is_named(rig, change):
    size = rig.size[0] + change[0], rig.size[1] + change[1]
    outline = rig.outline((0.2, -0.1), size=size)
    found = rig.number(outline)
    reason = f"found {size[0]} x {size[1]} corners, expected 20 x 20"
    assert_refused(found, GridFault.OTHER_SIZE, reason)


@pytest.mark.parametrize(("rows", "cols"), [(18, 13), (19, 13)])
def test_a_mirrored_view_that_differs_in_its_colours_alone_is_named(rows, cols):
    """Seen straight from below, a mirror image has the same shape."""
    sensor = load_sensor("sample_rig")
    pattern = replace(sensor.pattern, rows=rows, cols=cols, surface=PatternSurface())
    below = np.diag([1.0, -1.0, -1.0, 1.0])
    below[2, 3] = 0.03
    size = ImageSize(640, 480)
    rig = Rig(
        replace(
            sensor,
            pattern=pattern,
            image=size,
            camera=Camera("pinhole", 800.0, 800.0, 319.5, 239.5, 5 * (0.0,)),
            optics=Optics("monocular", below, ()),
            views={"left": ViewDescription(Roi(0, 0, size.width, size.height))},
        )
    )
    outline = rig.outline()
    assert rig.number(outline).fault is GridFault.NONE
    mirrored = outline[:, ::-1].copy()
    mirrored[..., 0] = 2 * rig.nominal.corners[..., 0].mean() - mirrored[..., 0]
    # 14 checkers in a row: from the other end, the first has the other colour.
    rig.dark_first = not rig.dark_first
    assert_refused(rig.number(mirrored), GridFault.MIRRORED, "views.<view>.mirror first")


def test_a_mirrored_view_is_named(rig):
    """What a sensor file with the wrong `flip` makes of the view."""
    outline = rig.outline((0.3, -0.2), bump=1.0)
    mirrored = outline[:, ::-1].copy()
    mirrored[..., 0] = 2 * rig.nominal.corners[..., 0].mean() - mirrored[..., 0]
    # 21 checkers in a row: the first has its own colour from either end.
    reason = "views.<view>.mirror and views.<view>.roi"
    assert_refused(rig.number(mirrored), GridFault.MIRRORED, reason)
