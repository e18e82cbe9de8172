"""Which pattern to print for a camera, and how large its checkers are in the image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import MAX_CORNERS, MIN_CORNERS, Pattern

# Measured by a sweep of prints, resolutions and lights, with tables in
# benchmarks/results/pattern_choice.md and the source, benchmarks/paper/pattern_choice.py, in commit
# 43949c8.  Sides are the smallest of both views.  Of checkers of RECOMMENDED_SIDE_PX the field
# between the markers is off by less than a third more than of the best ones, whatever the
# resolution and the light; below LEAST_SIDE_PX markers are lost in dim light or behind a soft lens.
LEAST_SIDE_PX = 6.0
RECOMMENDED_SIDE_PX = 7.0
# Dots of a code are read from this side on, and from the second on gridlines are as exact as
# without dots, to 5 %; both in focus: benchmarks/tracking/coded.py.
LEAST_CODED_SIDE_PX, EXACT_CODED_SIDE_PX = 7.5, 16.0
# A finer pitch than this share of the skin's thickness shows no more of a contact, however fine the
# camera's pixels.  Measured with a skin of 0.3 mm and beads of 1.2 mm; that it goes with the skin
# is assumed.
LEAST_PITCH_OVER_SKIN = 1.3
# More than these lower the error by less than 3 %, and cost time.
POINTS_PER_SEGMENT = 2
# A print of the same size as before is not larger in spite of rounding.
ROUNDING = 1e-6


@dataclass(frozen=True)
class PatternAdvice:
    """rows, cols: inner corners; pitch m; least_side_px: shortest checker side of both views.

    reason: a sentence that says why.
    """

    rows: int
    cols: int
    pitch: float
    points_per_segment: int
    least_side_px: float
    reason: str


def checker_sides_px(sensor: SensorDescription) -> dict[str, NDArray[np.float64]]:
    """Sides (N,) px of all checkers between inner corners at rest, by view.

    NaN where a view's lens has no pixel for a corner.  Raises DescriptionError where a view does
    not show the pattern, and where there is none.
    """
    return _sides(sensor.pattern, _views_of(sensor))


def _views_of(sensor: SensorDescription) -> dict[str, ViewGeometry]:
    if not sensor.views:
        msg = f"{sensor.origin}: views: found none, expected at least one that shows the pattern"
        raise DescriptionError(msg)
    return build_views(sensor)


def code_advice(sensor: SensorDescription) -> str:
    """What the dots of a code are like in this sensor's views, a sentence.

    Raises DescriptionError where a view does not show the pattern.
    """
    side = _least(sensor.pattern, _views_of(sensor))
    checkers = f"in checkers of {side:.1f} px (the smallest) dots"
    if side < LEAST_CODED_SIDE_PX:
        return f"{checkers} cannot be read: at least {LEAST_CODED_SIDE_PX:g} px are needed"
    if side < EXACT_CODED_SIDE_PX:
        return (
            f"{checkers} can be read in focus, but make gridlines less exact; from "
            f"{EXACT_CODED_SIDE_PX:g} px on they do not"
        )
    return f"{checkers} can be read, and gridlines are as exact as without dots"


def advise(sensor: SensorDescription) -> PatternAdvice:
    """The pattern to print on this sensor's gel, as large as the present one with its margin.

    The sensor's camera, optics, skin and size of the print count, not its present rows, columns
    and pitch.  Raises DescriptionError where a view does not show the present pattern.
    """
    views = _views_of(sensor)
    least_pitch = LEAST_PITCH_OVER_SKIN * sensor.elastomer.shading_layer.thickness
    chosen, side = sensor.pattern, _least(sensor.pattern, views)
    by_skin = False
    for checkers in range(MAX_CORNERS + 1, MIN_CORNERS, -1):
        pattern = _on_print(sensor.pattern, checkers)
        if min(pattern.rows, pattern.cols) < MIN_CORNERS:
            break
        chosen, side = pattern, _least(pattern, views)
        if side >= RECOMMENDED_SIDE_PX:
            if pattern.pitch >= least_pitch:
                break
            by_skin = True
    return PatternAdvice(
        rows=chosen.rows,
        cols=chosen.cols,
        pitch=chosen.pitch,
        points_per_segment=POINTS_PER_SEGMENT,
        least_side_px=side,
        reason=_reason(chosen, side, by_skin=by_skin),
    )


def _reason(pattern: Pattern, side: float, *, by_skin: bool) -> str:
    """by_skin: the camera would see more checkers well."""
    if side < LEAST_SIDE_PX:
        return (
            f"even with {pattern.rows} x {pattern.cols} corners the smallest checker is only "
            f"{side:.1f} px wide, and below {LEAST_SIDE_PX:g} px markers are lost: the camera has "
            "too few pixels, or is too far from the gel"
        )
    if side < RECOMMENDED_SIDE_PX:
        return (
            f"the smallest allowed number of corners gives checkers of {side:.1f} px (the "
            f"smallest); {RECOMMENDED_SIDE_PX:g} px would be better"
        )
    if by_skin:
        return (
            f"the camera could see smaller checkers than these of {side:.1f} px, but the skin "
            f"over the pattern blurs details below {pattern.pitch * 1e3:.2f} mm"
        )
    if max(pattern.rows, pattern.cols) == MAX_CORNERS:
        return (
            f"the largest allowed number of corners still gives checkers of {side:.1f} px (the "
            f"smallest); {RECOMMENDED_SIDE_PX:g} px are enough"
        )
    return (
        f"the smallest checker of both views is then {side:.1f} px wide: below "
        f"{RECOMMENDED_SIDE_PX:g} px, markers are less exact; with larger checkers there are "
        "fewer markers"
    )


def _on_print(pattern: Pattern, checkers: int) -> Pattern:
    """So many checkers along the longer side of a print that is not larger than before."""
    width, height = ((count + 1) * pattern.pitch for count in (pattern.cols, pattern.rows))
    pitch = max(width, height) / checkers
    cols, rows = (int(length / pitch + ROUNDING) - 1 for length in (width, height))
    return replace(pattern, rows=rows, cols=cols, pitch=pitch)


def _least(pattern: Pattern, views: dict[str, ViewGeometry]) -> float:
    return min(float(np.min(sides)) for sides in _sides(pattern, views).values())


def _sides(pattern: Pattern, views: dict[str, ViewGeometry]) -> dict[str, NDArray[np.float64]]:
    found = {}
    for name, view in views.items():
        corners = view.project(pattern.corners())
        steps = [np.linalg.norm(np.diff(corners, axis=axis), axis=-1).ravel() for axis in (0, 1)]
        found[name] = np.concatenate(steps)
    return found
