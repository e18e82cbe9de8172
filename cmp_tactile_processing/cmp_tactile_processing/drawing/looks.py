"""Colours and words of what is drawn: depth, forces, and contacts by their slip state."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.force.advice import SLIP_WORDS
from cmp_tactile_processing.measured import Contact, SlipState

# Digits after the point of forces, N.
LEAST_DIGITS, MOST_DIGITS = 2, 4
MESH_ALPHA = 0.85
DISPLACEMENT_COLOUR = (1.0, 1.0, 1.0, 1.0)
FORCE_COLOUR = (1.0, 0.25, 0.1, 1.0)
UNKNOWN_COLOUR = (0.75, 0.85, 1.0, 1.0)
LEGEND_COLOUR = (0.9, 0.9, 0.9, 1.0)
SLIP_COLOURS = {
    SlipState.UNKNOWN: UNKNOWN_COLOUR,
    SlipState.NO_CONTACT: UNKNOWN_COLOUR,
    SlipState.STICK: (0.2, 1.0, 0.2, 1.0),
    SlipState.INCIPIENT: (1.0, 0.75, 0.1, 1.0),
    SlipState.FULL: (1.0, 0.1, 0.5, 1.0),
}


def _palette() -> NDArray[np.float32]:
    bgr = cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_VIRIDIS)
    rgb = bgr.reshape(-1, 3)[:, ::-1] / 255.0
    return np.hstack([rgb, np.full((256, 1), MESH_ALPHA)]).astype(np.float32)


# (256, 4): from no indentation to that of depth_range.
DEPTH_PALETTE = _palette()


def depth_colours(shares: NDArray[np.float64]) -> NDArray[np.float32]:
    """Colours (..., 4) RGBA, 0 to 1, for shares of the largest depth; those outside are clipped."""
    last = len(DEPTH_PALETTE) - 1
    return DEPTH_PALETTE[np.rint(last * np.clip(shares, 0.0, 1.0)).astype(np.intp)]


def with_deviation(value: float, variance: float) -> str:
    """A value, and its standard deviation with one digit that is not 0 where it is known."""
    deviation = math.sqrt(variance) if variance > 0 else 0.0
    digits = LEAST_DIGITS
    while digits < MOST_DIGITS and float(f"{deviation:.{digits}f}") == 0.0:
        digits += 1
    if float(f"{deviation:.{digits}f}") == 0.0:
        return f"{value:.{LEAST_DIGITS}f}"
    return f"{value:.{digits}f} +/- {deviation:.{digits}f}"


def contact_lines(contact: Contact) -> list[str]:
    """What is written at a contact: normal force and its deviation, area and slip state.

    ASCII: RViz has no other letters.
    """
    force = with_deviation(float(contact.wrench[2]), float(contact.covariance[2, 2]))
    lines = [f"Fz {force} N", f"{contact.area * 1e6:.1f} mm^2"]
    if contact.at_border:
        lines[-1] += ", at the border"
    if contact.slip.state not in (SlipState.UNKNOWN, SlipState.NO_CONTACT):
        lines.append(SLIP_WORDS[contact.slip.state])
    return lines
