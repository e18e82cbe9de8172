"""Which numbers a connected set of corners bears: where the pattern was seen to end decides.

The sets are those that gridlines connect, without those whose colours are in doubt.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.tracking.corners.evidence import blur_evidence
from cmp_tactile_processing.tracking.detector import (
    Component,
    CornerGraph,
    NominalAxes,
    NominalGrid,
)
from cmp_tactile_processing.tracking.numbering.components import GridlinePointers
from cmp_tactile_processing.tracking.numbering.faulty_view import LITTLE_MOTION
from cmp_tactile_processing.tracking.numbering.pattern_border import BorderSide, border_sides

Float = NDArray[np.float64]
Whole = NDArray[np.intp]

# Of a set's displacements from a place on the nominal grid this quantile counts: the gel moves
# least at its rim.
ANCHOR_QUANTILE = 0.2
# No gel moves farther than this as a whole, in sides.
LARGEST_SHIFT = 3.5
# Of two borders too close to each other, one that lies this near to its nominal place is the
# pattern's, where the other lies at least as far from its own, in sides: no gel is moved by so
# much, and another pattern with the same centre would have both equally far.
PATTERNS_AND_NOT = ((1.5, 4.0), (0.8, 3.2))
# An incomplete grid farther from its nominal place than this is as likely to be another part of
# the pattern behind an occluder with a straight edge; in sides, by the lines that the pattern has
# at most: the fewer corners a border has, the easier an edge follows it.
FAR = ((5, 0.8), (9, 1.6))
# Where colours and extent alone leave one place, this share of the corners must be seen.
MOST = 0.6
# A place that fits the nominal grid better by this speaks against another, in sides.
CLEARLY_BETTER = 0.4
# Margins of one pattern look alike: brightness between dark and light checkers.
SAME_MARGIN = 0.3
# An outermost line with fewer corners than this share of its length is not a line of the pattern.
# Where there are more lines than the pattern has, fewer than the second share.
LEAST_SUPPORT, LEAST_SUPPORT_TOO_MANY = 0.2, 0.4
# With at least this share a line is one, whatever is seen beyond it.
FULL_SUPPORT = 0.7
# Sides in the order of `border_sides`: their axis, and whether at the axis' end.
SIDES = ((0, False), (0, True), (1, False), (1, True))
# Fewer corners than this, or lines than this along i or j, have no border of their own.
FEWEST_CORNERS, FEWEST_LINES = 9, 3
# Corners of which the misfit of every place is measured.
SAMPLE = 60

# Components of fewer corners are clutter as often as they are part of the pattern.
SMALLEST_JOINED = 2
# Checkers without sharp edges, and with less contrast than this, may be light where they should be
# dark: beyond the first zero of its transfer function, blur exchanges them.  A lens out of focus
# leaves 13 % of the first harmonic there, and a straight smear 22 %, with a sharpness below 0.6;
# where neither has exchanged the colours, blur of a third of a side leaves more contrast.
LEAST_SHARPNESS, LEAST_CONTRAST = 0.7, 0.3


@dataclass(frozen=True)
class Anchor:
    """What to add to a component's numbers, or None with the fault and the reason in words.

    ends: whether the pattern was seen to end, in the order of `border_sides`; unlikely: whether the
    nominal grid alone would have it elsewhere; one_border: whether along i, and along j, one border
    alone distinguishes this place from another one that the gel could have been moved to.
    """

    shift: Whole | None
    fault: GridFault = GridFault.NONE
    reason: str = ""
    ends: tuple[bool, ...] = (False,) * 4
    unlikely: bool = False
    one_border: tuple[bool, bool] = (False, False)


class ComponentPlacement:
    """Anchors components of corners to one view's grid.

    nominal: in pixels of the prepared image; dark_first: whether the checker outside corner (0, 0)
    is a dark one.
    """

    def __init__(self, nominal: NominalGrid, dark_first: bool) -> None:
        self._nominal = nominal
        self._size = nominal.corners.shape[0], nominal.corners.shape[1]
        self._dark_first = dark_first
        self._far = next((far for most, far in FAR if min(self._size) <= most), LARGEST_SHIFT)
        self._side = np.linalg.norm(nominal.col_step, axis=-1)

    def anchor(self, component: Component, image: PreparedImage, previous: Float | None) -> Anchor:
        """The component's place, from its borders, colours and extent, or why it is not known.

        previous: (rows, cols, 2) px, the last frame's corners.

        A complete set fits in one way only.  Of an incomplete one an axis is known where the
        pattern was seen to end on one side at least, or where the colours leave one place only.
        That the corners lie near a nominal place, or near the last frame's, proves nothing after a
        knock of two checkers; where either speaks against what the borders show, more of the
        border must be seen.
        """
        found = _Look.at(component, image, self._size)
        if found is None:
            return Anchor(
                None, GridFault.AMBIGUOUS, f"only {len(component.position)} connected corners"
            )
        even = found.even == self._dark_first
        places = _Places.from_component(found.component, self._nominal, self._side, even)
        rows = _axis_claims(found, 0, self._size[0], places)
        cols = _axis_claims(found, 1, self._size[1], places)
        for axis in (rows, cols):
            if axis.other_size:
                return Anchor(None, GridFault.OTHER_SIZE, self._other_size(found))
        return self._decide(found, places, (rows, cols), previous)

    def _other_size(self, found: _Look) -> str:
        lines = found.lattice.shape
        return f"found {lines[0]} x {lines[1]} corners, expected {self._size[0]} x {self._size[1]}"

    def _decide(
        self, found: _Look, places: _Places, axes: tuple[_Axis, _Axis], previous: Float | None
    ) -> Anchor:
        fits = np.array([axes[d].allows(places.shift[:, d]) for d in (0, 1)]).all(axis=0)
        left = np.flatnonzero(fits & places.colours)
        if len(left) == 0:
            return self._without_place(found, bool(fits.any()))
        if len(left) > 1:
            where = " and ".join(
                name for name, axis in zip(("rows", "columns"), axes, strict=True) if axis.open
            )
            reason = f"no border of the pattern is seen that shows which {where} these are"
            return Anchor(None, GridFault.AMBIGUOUS, reason)
        best = int(left[0])
        rival = _rival(places, best)
        doubt = self._doubt(found, places, axes, (best, rival))
        if doubt and not self._as_before(found, places.shift[best], previous):
            return Anchor(None, GridFault.AMBIGUOUS, doubt)
        others = places.others_along(best)
        if self._jumped(found, places, best, np.concatenate(others), previous):
            reason = "only one border is seen after a jump by whole checkers"
            return Anchor(None, GridFault.AMBIGUOUS, reason)
        return Anchor(
            places.shift[best] + found.first,
            ends=tuple(side.ends for side in found.sides),
            unlikely=rival is not None,
            one_border=(len(others[0]) > 0, len(others[1]) > 0),
        )

    def _is_complete(self, found: _Look) -> bool:
        return found.lattice.shape[:2] == self._size

    def _without_place(self, found: _Look, but_for_colours: bool) -> Anchor:
        sure = self._is_complete(found) or sum(side.firm for side in found.sides) >= 3
        if but_for_colours and sure:
            reason = "the colours do not fit: dark and light checkers seem to be exchanged"
            return Anchor(None, GridFault.OTHER_COLOURS, reason)
        reason = "no place on the grid fits the borders in the image"
        return Anchor(None, GridFault.AMBIGUOUS, reason)

    def _doubt(
        self,
        found: _Look,
        places: _Places,
        axes: tuple[_Axis, _Axis],
        best_and_rival: tuple[int, int | None],
    ) -> str:
        """Why the only place that is left may still be a wrong one, or nothing."""
        best, rival = best_and_rival
        misfit = places.misfit[best]
        unseen = not any(side.ends for side in found.sides)
        if self._is_complete(found):
            return (
                "a whole grid far from its place, and no border is seen"
                if unseen and misfit > 1
                else ""
            )
        if misfit > self._far:
            return f"the border lies {misfit:.1f} checkers from its nominal place"
        by_chance = any(axis.claimed is None for axis in axes)
        if by_chance and (misfit > 1 or len(found.component.position) < MOST * self._side.size):
            return "no border of the pattern is seen"
        if rival is None:
            return ""
        # One border may be a straight occluder's edge; two at their distance are not.
        against = places.shift[best] != places.shift[rival]
        proven = all(not against[d] or axes[d].full for d in (0, 1))
        return "" if proven else "border and nominal projection put the corners at different places"

    def _as_before(self, found: _Look, shift: Whole, previous: Float | None) -> bool:
        return self._moved(found, shift, previous) <= LITTLE_MOTION

    def _jumped(
        self, found: _Look, places: _Places, best: int, others: Whole, previous: Float | None
    ) -> bool:
        """Whether since the last frame the gel would have moved much less to another place."""
        if not len(others) or previous is None:
            return False
        moved = self._moved(found, places.shift[best], previous)
        less = min(self._moved(found, places.shift[other], previous) for other in others)
        return np.isfinite(moved) and moved > LITTLE_MOTION and less < moved - CLEARLY_BETTER

    def _moved(self, found: _Look, shift: Whole, previous: Float | None) -> float:
        """Median motion since the last frame in sides; inf where that frame does not show it."""
        if previous is None:
            return float("inf")
        i, j = (found.component.number + shift).T
        moved = np.linalg.norm(found.component.position - previous[i, j], axis=1) / self._side[i, j]
        moved = moved[np.isfinite(moved)]
        return float(np.median(moved)) if len(moved) >= FEWEST_CORNERS else float("inf")


@dataclass(frozen=True)
class _Look:
    """A component without stray lines, as a lattice from (0, 0), and what lies beyond its sides.

    first: to be subtracted from the component's own numbers, as a shift; even: of corner (0, 0).
    """

    component: Component
    first: Whole
    lattice: Float
    even: bool
    sides: list[BorderSide]

    @classmethod
    def at(
        cls, component: Component, image: PreparedImage, expected: tuple[int, int]
    ) -> _Look | None:
        """What is seen of a component, or None where too little of it is left.

        A detector may see corners on the margin: a border then lies a line further in.
        """
        look = cls._of(_without_stragglers(component, expected), image, expected)
        for index in range(len(SIDES)):
            if look is None:
                return None
            line = look.doubtful_line(index)
            if line.any() and not line.all():
                inner = cls._of(_part(look.component, ~line), image, expected)
                if inner is not None and inner.sides[index].ends:
                    look = replace(inner, first=inner.first + look.first)
        return look

    @classmethod
    def _of(
        cls, component: Component, image: PreparedImage, expected: tuple[int, int]
    ) -> _Look | None:
        first = component.number.min(axis=0)
        number = component.number - first
        extent = number.max(axis=0) + 1
        if len(number) < FEWEST_CORNERS or extent.min() < FEWEST_LINES:
            return None
        lattice, even = component.lattice()
        sides = border_sides(image, lattice, even, expected)
        return cls(replace(component, number=number), -first, lattice, even, sides)

    def doubtful_line(self, index: int) -> NDArray[np.bool_]:
        """Corners of the outermost line at a side where it may lie on the margin."""
        side, (axis, last) = self.sides[index], SIDES[index]
        extent = self.lattice.shape[axis]
        line: NDArray[np.bool_] = self.component.number[:, axis] == (extent - 1 if last else 0)
        sparse = line.sum() < FULL_SUPPORT * self.lattice.shape[1 - axis]
        doubtful = side.over or (sparse and not side.ends and not side.goes_on)
        return line if doubtful else np.zeros_like(line)


@dataclass(frozen=True)
class _Places:
    """Where a component could lie: shift (n, 2), misfit (n,) in sides, colours (n,) fit there."""

    shift: Whole
    misfit: Float
    colours: NDArray[np.bool_]

    @classmethod
    def from_component(
        cls, component: Component, nominal: NominalGrid, side: Float, even: bool
    ) -> _Places:
        """All places on the grid; misfit inf where it is larger than any that counts."""
        room = np.array(nominal.corners.shape[:2]) - component.number.max(axis=0)
        shift = np.stack(np.meshgrid(*map(np.arange, np.maximum(room, 0)), indexing="ij"), axis=-1)
        shift = shift.reshape(-1, 2).astype(np.intp)
        colours = (shift.sum(axis=1) % 2 == 0) == even
        chosen = np.linspace(0, len(component.position) - 1, min(SAMPLE, len(component.position)))
        chosen = chosen.astype(np.intp)
        position, number = component.position[chosen], component.number[chosen]
        misfit = _misfits(position, number, shift, (nominal.corners, side))
        return cls(shift, misfit, colours)

    def others_along(self, best: int) -> tuple[Whole, Whole]:
        """Places farther along i, and farther along j, that colours and the gel's reach allow."""
        possible = self.colours & (self.misfit <= LARGEST_SHIFT)
        same = self.shift == self.shift[best]
        along_i, along_j = (possible & ~same[:, d] & same[:, 1 - d] for d in (0, 1))
        return np.flatnonzero(along_i), np.flatnonzero(along_j)


@dataclass(frozen=True)
class _Axis:
    """What is known of a component's place along one axis.

    claimed: the shift that borders show, or None; full: as many lines as the pattern has;
    low, high: what is left by the sides beyond which the pattern goes on; other_size: whether the
    borders lie at another distance than the pattern's.
    """

    claimed: int | None
    full: bool
    low: int
    high: int
    other_size: bool = False

    @property
    def open(self) -> bool:
        return self.claimed is None and self.low < self.high

    def allows(self, shift: Whole) -> NDArray[np.bool_]:
        inside = (shift >= self.low) & (shift <= self.high)
        return inside if self.claimed is None else inside & (shift == self.claimed)


def _axis_claims(found: _Look, axis: int, lines: int, places: _Places) -> _Axis:
    first, last = found.sides[2 * axis], found.sides[2 * axis + 1]
    extra = lines - found.lattice.shape[axis]
    low, high = int(first.goes_on), extra - int(last.goes_on)
    if extra == 0:
        # A line that goes on beyond both ends is longer than the pattern's.
        return _Axis(0, True, 0, 0, other_size=first.goes_on or last.goes_on)
    if extra < 0:
        return _Axis(None, False, low, high, other_size=True)
    claims = [(side, shift) for side, shift in ((first, 0), (last, extra)) if side.ends]
    claims = _with_margin_of(found.sides[2 - 2 * axis : 4 - 2 * axis], claims)
    if len(claims) == 2:
        # Borders too close to each other: another pattern, unless one is an occluder's edge.
        claims.sort(key=lambda claim: _least(places, axis, claim[1]))
        near, far = (_least(places, axis, shift) for _, shift in claims)
        if any(near <= least and far >= most for least, most in PATTERNS_AND_NOT):
            claims = claims[:1]
        elif all(side.firm for side, _ in claims):
            return _Axis(None, False, low, high, other_size=True)
        else:
            claims = [claim for claim in claims if claim[0].firm]
            if not claims:
                return _Axis(None, False, 1, 0)
    claims = [claim for claim in claims if _least(places, axis, claim[1]) <= LARGEST_SHIFT]
    return _Axis(claims[0][1], False, 0, extra) if claims else _Axis(None, False, low, high)


def _with_margin_of(
    beside: list[BorderSide], claims: list[tuple[BorderSide, int]]
) -> list[tuple[BorderSide, int]]:
    """The claims beyond which it is as bright as beyond the borders on the sides beside them."""
    levels = [side.level for side in beside if side.firm]
    if not levels:
        return claims
    return [
        claim
        for claim in claims
        if min(abs(claim[0].level - level) for level in levels) <= SAME_MARGIN
    ]


def _least(places: _Places, axis: int, shift: int) -> float:
    """The smallest misfit of the places with a shift along an axis."""
    return float(np.min(places.misfit[places.shift[:, axis] == shift], initial=np.inf))


def _rival(places: _Places, best: int) -> int | None:
    """A place with fitting colours that the nominal projection clearly prefers to the best."""
    misfit = np.where(places.colours, places.misfit, np.inf)
    rival = int(misfit.argmin())
    return rival if misfit[rival] < places.misfit[best] - CLEARLY_BETTER else None


def _misfits(position: Float, number: Whole, shift: Whole, nominal: tuple[Float, Float]) -> Float:
    """Misfit (m,) in sides of n corners at each of m places; inf where it is too large to count.

    position, number (n, 2); shift (m, 2); nominal: corners (rows, cols, 2) px and sides (rows,
    cols) px.
    """
    misfit = np.full(len(shift), np.inf)
    # Three corners at first: most places of a small component are far away.
    some = np.linspace(0, len(position) - 1, 3).astype(np.intp)
    least = _distances(position[some], number[some], shift, nominal).min(axis=1)
    near = least <= 2 * LARGEST_SHIFT
    rank = int(ANCHOR_QUANTILE * (len(position) - 1))
    distance = _distances(position, number, shift[near], nominal)
    misfit[near] = np.partition(distance, rank, axis=1)[:, rank]
    return misfit


def _distances(position: Float, number: Whole, shift: Whole, nominal: tuple[Float, Float]) -> Float:
    """Distances (m, n) in sides of n corners from their nominal ones at m places."""
    i, j = np.moveaxis(number + shift[:, None], -1, 0)
    corners, side = nominal
    return np.asarray(np.linalg.norm(position - corners[i, j], axis=-1) / side[i, j])


def _without_stragglers(component: Component, expected: tuple[int, int]) -> Component:
    """The component without outermost lines of a few stray corners."""
    while True:
        number = component.number - component.number.min(axis=0)
        stray = np.zeros(len(number), dtype=bool)
        for axis in (0, 1):
            count = np.bincount(number[:, axis])
            least = LEAST_SUPPORT if len(count) <= expected[axis] else LEAST_SUPPORT_TOO_MANY
            for outermost in (0, len(count) - 1):
                if count[outermost] < least * (number[:, 1 - axis].max() + 1):
                    stray |= number[:, axis] == outermost
        if not stray.any() or stray.all():
            return component
        component = _part(component, ~stray)


def _part(component: Component, chosen: NDArray[np.bool_]) -> Component:
    return Component(component.position[chosen], component.number[chosen], component.even[chosen])


class ConnectedCorners:
    """Finds them in the graphs of one view; keeps its buffers.

    axes: steps of the pattern at rest near a point of the prepared image.
    """

    def __init__(self, axes: NominalAxes) -> None:
        self.axes = axes
        self._pointers = GridlinePointers()

    def components(self, graph: CornerGraph, image: PreparedImage) -> tuple[list[Component], str]:
        """Sets of connected corners, the largest first, and why some are not to be believed."""
        components = self.all_components(graph)
        return without_blurred(components, image) if components else ([], "")

    def all_components(self, graph: CornerGraph) -> list[Component]:
        """Sets of connected corners, the largest first, however blurred they are."""
        steps = self.axes.near(graph.position)
        return self._pointers.components(graph, *steps, fewest=SMALLEST_JOINED)


def without_blurred(
    components: list[Component], image: PreparedImage
) -> tuple[list[Component], str]:
    """The components in which light and dark can be trusted, and what speaks against the largest.

    Components that are too small to be judged go with the largest.
    """
    kept: list[Component] = []
    reason = ""
    for index, component in enumerate(components):
        if len(component.position) < FEWEST_CORNERS:
            return kept if reason else kept + components[index:], reason
        sharpness, contrast = blur_evidence(image.grey, *component.lattice())
        if not (sharpness < LEAST_SHARPNESS and contrast < LEAST_CONTRAST):
            kept.append(component)
        elif index == 0:
            reason = (
                "out of focus or motion blur: checkers without sharp edges, contrast "
                f"{contrast:.0%}"
            )
    return kept, reason
