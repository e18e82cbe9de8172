"""What to print, how to mount it, and what the camera will see of it, in words and numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.printing.pattern import (
    CHORD_TOLERANCE,
    PatternAdvice,
    PrintedPattern,
    PrintOptions,
    advise,
    checker_sides_px,
    code_advice,
)
from cmp_tactile_processing.printing.sheet import PrintSheet
from cmp_tactile_processing.sensor.description import SensorDescription

PROCESSES = {
    "along_axis": "along_axis: pad or transfer printing, or exposure, along the gel's z axis",
    "unrolled": "unrolled: a film, printed flat and laid around the gel",
}


def print_facts(printed: PrintedPattern, sheet: PrintSheet) -> dict[str, str]:
    """Size, process, side, and place on the sheet."""
    options = printed.options
    size = _size(printed)
    with_margin = size + 2e3 * options.margin
    facts = {
        "Pattern": _kind(printed),
        "Ink": _ink(options),
        "Size": f"{_mm(size)}, {_mm(with_margin)} with its margin",
        "Process": PROCESSES[printed.process],
        "Seen from": "seen from the camera (mirrored): the printed side goes onto the gel"
        if sheet.mirrored
        else "seen from the touching side: the printed side faces away from the gel",
        "Sheet": f"{sheet.width:g} x {sheet.height:g} mm",
        "Apex on the sheet": (
            f"({sheet.apex[0]:.3f}, {sheet.apex[1]:.3f}) mm from the top left corner"
        ),
    }
    if printed.process == "unrolled":
        facts["Curved edges"] = f"polygons within {CHORD_TOLERANCE * 1e6:g} um"
    if printed.rim_strain:
        facts["Stretch of the film"] = (
            f"{100 * printed.rim_strain:+.2f} % along the rim, at the farthest corner of the "
            "margin; none along lines from the apex. A flat film does not fit a sphere without "
            "stretch"
        )
    return facts


def seen_facts(sensor: SensorDescription) -> dict[str, str]:
    """What the camera will see of it, and which checkers would be better."""
    try:
        sides = checker_sides_px(sensor)
    except InputError as error:
        return {"Checker side": _not_known(sensor, error)}
    facts = {f"Checker side {view}": _sides(values) for view, values in sides.items()}
    facts["Advised"] = _advised(sensor)
    if sensor.pattern.code != "none":
        facts["Code"] = code_advice(sensor)
    return facts


def advice_of(sensor: SensorDescription) -> PatternAdvice:
    """As advise has it; InputError where a view does not show the whole print."""
    for view, sides in checker_sides_px(sensor).items():
        if not np.isfinite(sides).all():
            raise InputError(
                f"{sensor.origin}: views.{view}: found corners of the pattern outside the lens's "
                "field, expected none; there is no advice for a print of this size"
            )
    return advise(sensor)


def _not_known(sensor: SensorDescription, error: InputError) -> str:
    """Without the file, which stands above."""
    return f"not known: {str(error).removeprefix(f'{sensor.origin}: ')}"


def _advised(sensor: SensorDescription) -> str:
    try:
        advice = advice_of(sensor)
    except InputError as error:
        return _not_known(sensor, error)
    return (
        f"{advice.rows} x {advice.cols} corners, pitch {advice.pitch * 1e3:.6g} mm, "
        f"{advice.points_per_segment} virtual markers between: {advice.reason}"
    )


def pattern_warnings(sensor: SensorDescription, printed: PrintedPattern) -> list[str]:
    """What should be known before it is printed."""
    warnings = []
    if not printed.fits_gel:
        found = _mm(_size(printed) + 2e3 * printed.options.margin)
        block = _mm(np.array(sensor.elastomer.size[:2]) * 1e3)
        warnings.append(
            f"pattern with margin: found {found}, expected at most the gel's block, {block}"
        )
    if printed.gel is None:
        warnings.append(
            "the gel's block is larger than its surface (pattern.surface.radius), so its outline "
            "is not drawn on the flat print"
        )
    return warnings


def _kind(printed: PrintedPattern) -> str:
    pattern = printed.pattern
    pitch = f"pitch {pattern.pitch * 1e3:.6g} mm"
    outside = f"{pattern.corner_checker} checker outside corner (0, 0)"
    code = f", code: {pattern.code}, seed {pattern.code_seed}" if pattern.code != "none" else ""
    return f"{pattern.rows} x {pattern.cols} corners, {pitch}, {outside}{code}"


def _ink(options: PrintOptions) -> str:
    part = "the dark checkers"
    if options.invert:
        part = f"everything except {part}, margin and bleed included (inverted)"
    gain = f";  {options.ink_gain * 1e6:g} um removed at each edge" if options.ink_gain else ""
    return f"{part}{gain}"


def _size(printed: PrintedPattern) -> NDArray[np.float64]:
    """Of the checkers on the gel, x and y, mm."""
    pattern = printed.pattern
    return np.array([pattern.cols + 1, pattern.rows + 1]) * pattern.pitch * 1e3


def _sides(values: NDArray[np.float64]) -> str:
    seen = values[np.isfinite(values)]
    if not len(seen):
        return "not seen"
    hidden = "" if len(seen) == len(values) else "; some corners are outside the lens's field"
    return f"{seen.min():.1f} px at least, {seen.mean():.1f} px on average{hidden}"


def _mm(size: NDArray[np.float64]) -> str:
    return f"{size[0]:.6g} x {size[1]:.6g} mm"
