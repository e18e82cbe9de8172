"""Numbers the corners of a coded pattern: each connected piece by the dots that it shows.

No border, earlier frame or nominal place is needed.  Small pieces, of which dots leave several
places, are numbered where they continue what is numbered already.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_processing.tracking.detector import Component, NominalAxes, NominalGrid
from cmp_tactile_processing.tracking.dots import Decoding, DotDecoder, DotReading, read_dots
from cmp_tactile_processing.tracking.numbering.faulty_view import (
    TURNED_SHARE,
    turned_by,
    turned_reason,
)
from cmp_tactile_processing.tracking.numbering.joining import (
    drop_loose_corners,
    in_order,
    joined,
    placed,
)
from cmp_tactile_processing.tracking.numbering.result import (
    JOINED_CONFIDENCE,
    OTHER_PATTERN,
    Numbering,
    not_seen,
)

Float = NDArray[np.float64]
# Fewer corners are surrounded by too few checkers to be compared with each other.
FEWEST_READ = 6
# A piece lies within so many checkers of where the nearest numbered corner suggests, and so many
# more for each checker in between: the gel strains by no more.
REACH, REACH_PER_CHECKER = 2, 0.15


@dataclass(frozen=True, eq=False)
class _Piece:
    """A component with the dots around it; found: its likeliest place on the sheet."""

    component: Component
    reading: DotReading
    first_dark: bool
    found: Decoding | None = None

    @property
    def size(self) -> int:
        """Number of corners."""
        return len(self.component.position)

    @property
    def is_certain(self) -> bool:
        """Whether its dots alone show its place."""
        return self.found is not None and self.found.is_certain

    @property
    def is_upright(self) -> bool:
        """Whether the place found is neither turned nor mirrored and has the right colours."""
        found = self.found
        return found is not None and not (found.turns or found.mirrored or found.exchanged)

    @property
    def is_foreign(self) -> bool:
        """Whether its checkers are no part of the sheet."""
        by_dots = self.found is not None and self.found.is_foreign and self.reading.is_clear
        return by_dots or self.reading.is_bare

    @property
    def first(self) -> NDArray[np.intp]:
        """The component's own number of its lattice's corner (0, 0), (2,)."""
        return np.asarray(self.component.number.min(axis=0))

    def shift(self) -> NDArray[np.intp]:
        """What to add to the component's numbers at the place found."""
        place = self.first if self.found is None else self.found.shift
        return np.asarray(place - self.first)


class CodedView:
    """Numbers components of corners of one view.

    nominal: of the pattern, in pixels of the prepared image.  Of a sheet that goes on beyond the
    view all checkers are read, and the corners of the pattern are numbered.
    """

    def __init__(self, nominal: NominalGrid, axes: NominalAxes, pattern: Pattern) -> None:
        self._nominal, self._axes = nominal, axes
        self._dark_first = pattern.corner_checker == "dark"
        sheet = pattern.sheet((np.inf, np.inf))
        self._goes_on = pattern.border == "beyond_view"
        origin = (sheet.rows - pattern.rows) // 2, (sheet.cols - pattern.cols) // 2
        self._decoder = DotDecoder(sheet.dots(), sheet.corner_checker == "dark", origin)

    def number(self, components: list[Component], image: PreparedImage) -> Numbering | None:
        """The corners of components, largest first.

        None where no dots can be read in any, and the border may show the numbers.
        """
        pieces = [self._read(component, image) for component in components]
        if all(np.isnan(piece.reading.strength) for piece in pieces):
            if pieces[0].size >= FEWEST_READ and pieces[0].reading.is_bare:
                return self._missing(*_other_code(pieces[0]))
            return self._unread()
        certain = [piece for piece in pieces if piece.is_certain]
        if not certain or not certain[0].is_upright:
            refused = certain[0] if certain else pieces[0]
            found = _refused(refused)
            return self._unread() if found is None else self._missing(*found)
        corners = np.full_like(self._nominal.corners, np.nan)
        for piece in certain:
            if piece.is_upright and not placed(corners, piece.component, piece.shift()):
                reason = "two pieces with the same dots: the pattern is seen twice"
                return self._missing(GridFault.TWO_PATTERNS, reason)
        if np.isnan(corners).all():
            reason = f"{certain[0].size} corners seen, all outside of rows x cols"
            return self._missing(GridFault.PARTLY_HIDDEN, reason)
        left = [piece for piece in pieces if not piece.is_certain and not piece.is_foreign]
        joins = self._join(corners, left)
        drop_loose_corners(corners, self._nominal.corners)
        other = max((piece.size for piece in pieces if piece.is_foreign), default=0)
        return self._judged(corners, other, JOINED_CONFIDENCE if joins else 1.0)

    def confirms(self, corners: Float, image: PreparedImage) -> bool:
        """Whether the dots beside corners (rows, cols, 2) px show that their numbers are right."""
        bits = read_dots(image, corners, self._dark_first).bits
        reach = np.array([REACH, REACH])
        found = self._decoder.decode(bits, self._dark_first, (-reach, reach))
        return found is not None and found.is_certain and not found.shift.any()

    def _read(self, component: Component, image: PreparedImage) -> _Piece:
        lattice, even = component.lattice()
        if len(component.position) < FEWEST_READ:
            return _Piece(component, DotReading.nothing(lattice.shape[:2]), even)
        reading = read_dots(image, lattice, even)
        found = self._decoder.decode(reading.bits, even) if reading.bits.any() else None
        return _Piece(component, reading, even, found)

    def _join(self, corners: Float, left: list[_Piece]) -> bool:
        """Add pieces that continue what is numbered; whether one was added without its dots."""
        by_shape = False
        before = len(left) + 1
        while left and len(left) < before:
            before = len(left)
            for piece in list(left):
                shift, decoded = self._near(corners, piece)
                if shift is not None and placed(corners, piece.component, shift):
                    by_shape |= not decoded
                    left.remove(piece)
        return by_shape

    def _near(self, corners: Float, piece: _Piece) -> tuple[NDArray[np.intp] | None, bool]:
        """The shift of a piece near what is numbered, and whether its dots alone decide it."""
        bits = piece.reading.bits
        first = piece.first
        if bits.any():
            guess, reach = self._expected(corners, piece.component)
            within = guess + first - reach, guess + first + reach
            found = self._decoder.decode(bits, piece.first_dark, within)
            if found is not None and found.is_certain:
                return found.shift - first, True
        shift = joined(corners, piece.component, self._nominal, self._dark_first)
        if shift is None or (bits.any() and self._decoder.evidence(bits, shift + first) <= 0):
            return None, False
        return shift, False

    def _expected(self, corners: Float, component: Component) -> tuple[NDArray[np.intp], int]:
        """The shift that the nearest numbered corner suggests, and how far it may be off."""
        known = np.argwhere(np.isfinite(corners[..., 0]))
        position = corners[known[:, 0], known[:, 1]]
        middle = component.position.mean(axis=0)
        nearest = int(np.argmin(((position - middle) ** 2).sum(axis=1)))
        steps = np.stack(self._axes.near(((position[nearest] + middle) / 2)[None]), axis=-1)[0]
        away = np.linalg.solve(steps, middle - position[nearest])
        shift = np.rint(known[nearest] + away - component.number.mean(axis=0)).astype(np.intp)
        return shift, REACH + int(np.ceil(REACH_PER_CHECKER * np.abs(away).max()))

    def _judged(self, corners: Float, other: int, confidence: float) -> Numbering:
        """other: corners that are connected and bear the dots of another code, or none."""
        if not in_order(corners, self._nominal):
            reason = "gridlines are stretched or out of order"
            return self._missing(GridFault.AMBIGUOUS, reason)
        known = np.isfinite(corners[..., 0])
        missing = int(known.size - known.sum())
        if known.sum() >= TURNED_SHARE * known.size:
            turned = turned_reason(corners[known], np.argwhere(known), self._nominal)
            if turned:
                return self._missing(GridFault.TURNED, turned)
        if not missing:
            return Numbering(corners, "", GridFault.NONE, confidence, by_code=True)
        fault, reason = GridFault.PARTLY_HIDDEN, not_seen(missing)
        if other >= OTHER_PATTERN * known.size:
            fault = GridFault.TWO_PATTERNS
            reason += f", and {other} of another pattern, according to their dots"
        return Numbering(corners, reason, fault, confidence, by_code=True)

    def _unread(self) -> Numbering | None:
        """What is reported where no dots can be read; None where there may be a border."""
        if not self._goes_on:
            return None
        return self._missing(GridFault.AMBIGUOUS, "the dots in the checkers cannot be read")

    def _missing(self, fault: GridFault, reason: str) -> Numbering:
        return Numbering.nothing(self._nominal.corners.shape[:2], fault, reason)


def _refused(piece: _Piece) -> tuple[GridFault, str] | None:
    """Why a piece has no number; None where its dots do not show that either."""
    found = piece.found
    if found is not None and found.is_certain:
        if found.mirrored:
            return GridFault.MIRRORED, (
                "the dots are those of the pattern's mirror image; "
                "check views.<view>.mirror and views.<view>.roi in the sensor's description"
            )
        if found.turns:
            return GridFault.TURNED, turned_by(90 * found.turns)
        return GridFault.OTHER_COLOURS, "the dots fit, but dark and light checkers are exchanged"
    if piece.is_foreign:
        return _other_code(piece)
    if found is None or not piece.reading.is_clear:
        return None
    reason = (
        f"the dots of the {found.readable} checkers seen do not identify their place with certainty"
    )
    return GridFault.AMBIGUOUS, reason


def _other_code(piece: _Piece) -> tuple[GridFault, str]:
    if piece.reading.is_bare:
        reason = "the checkers have no dots; check pattern.code in the sensor's description"
        return GridFault.OTHER_PATTERN, reason
    reason = "the dots are those of another sheet; check pattern.code_seed, rows and cols"
    return GridFault.OTHER_PATTERN, reason
