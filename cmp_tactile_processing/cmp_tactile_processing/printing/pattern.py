"""The pattern of a sensor as ink on a flat print, to scale."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import DescriptionError, ParameterError
from cmp_tactile_processing.printing.contours import (
    Contour,
    checker_contours,
    dot_contours,
    inset,
    light_checker_contours,
    on_print,
    rectangle,
    without,
)
from cmp_tactile_processing.printing.flat import (
    PROCESSES,
    default_process,
    flat_print,
    rim_strain,
)
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Pattern

__all__ = ["CHORD_TOLERANCE", "PATTERN_TYPES", "PrintOptions", "PrintedPattern", "printed_pattern"]

# Curved edges are polygons within this, m: a tenth of what the best printers resolve.
CHORD_TOLERANCE = 5e-7
PATTERN_TYPES = ("cmp", "dmp")


@dataclass(frozen=True)
class PrintOptions:
    """How the pattern is printed; lengths in m.

    pattern_type: cmp (checkers) or dmp (dots at the places of the corners, `dot_diameter` of the
    pitch wide).  process: as printed_flat has them, empty for the surface's default.  invert: ink
    is light, on dark skin.  ink_gain: by how much ink spreads at each edge, taken off beforehand.
    margin: light skin around the checkers, on which nothing else is printed.  bleed: how far
    inverted ink goes beyond it, and everything else stays away.
    """

    pattern_type: str = "cmp"
    process: str = ""
    invert: bool = False
    ink_gain: float = 0.0
    margin: float = 0.001
    bleed: float = 0.0
    dot_diameter: float = 0.5


@dataclass(frozen=True)
class PrintedPattern:
    """Polygons on the flat print, mm, apex at (0, 0), axes along the gel frame's x and y.

    ink: as Contour tells, no two overlap.  clear: what is kept free for pattern, margin and bleed.
    gel: outline of the gel's block, None where it reaches beyond the surface.
    rim_strain: of a film that is laid on a sphere.  fits_gel: pattern and margin lie on the block.
    """

    pattern: Pattern
    options: PrintOptions
    process: str
    ink: tuple[Contour, ...]
    clear: Contour
    gel: Contour | None
    rim_strain: float
    fits_gel: bool


def printed_pattern(
    sensor: SensorDescription, options: PrintOptions | None = None
) -> PrintedPattern:
    """The ink of a sensor's pattern.

    Raises DescriptionError for a pattern that does not lie on its surface, ParameterError for an
    option that does not go with it.
    """
    options = options or PrintOptions()
    pattern = sensor.pattern
    process = options.process or default_process(pattern.surface)
    _check(sensor, options, process)
    flat = partial(flat_print, pattern.surface, process)
    half = (pattern.cols + 1) * pattern.pitch / 2, (pattern.rows + 1) * pattern.pitch / 2
    around = options.margin + options.bleed
    clear = rectangle(half[0] + around, half[1] + around)
    with_margin = np.array(half) + options.margin
    gel = rectangle(sensor.elastomer.size[0] / 2, sensor.elastomer.size[1] / 2)
    laid = on_print(_ink(pattern, options, clear), flat, CHORD_TOLERANCE)
    fits = with_margin <= np.array(sensor.elastomer.size[:2]) / 2 * (1 + 1e-9)
    return PrintedPattern(
        pattern=pattern,
        options=options,
        process=process,
        ink=tuple(inset(contour, options.ink_gain) * 1e3 for contour in laid),
        clear=on_print([clear], flat, CHORD_TOLERANCE)[0] * 1e3,
        gel=_outline(gel, pattern, process),
        rim_strain=rim_strain(pattern.surface, process, rectangle(*with_margin)),
        fits_gel=bool(fits.all()),
    )


def _ink(pattern: Pattern, options: PrintOptions, clear: Contour) -> list[Contour]:
    """Contours on the gel, x and y, m."""
    if options.pattern_type == "cmp":
        if options.invert:
            return [clear, *light_checker_contours(pattern)]
        return checker_contours(pattern)
    dots = dot_contours(pattern, options.dot_diameter * pattern.pitch, CHORD_TOLERANCE)
    return [clear, *without(dots)] if options.invert else dots


def _outline(gel: Contour, pattern: Pattern, process: str) -> Contour | None:
    flat = partial(flat_print, pattern.surface, process)
    if not np.isfinite(flat(gel)).all():
        return None
    return on_print([gel], flat, CHORD_TOLERANCE)[0] * 1e3


def _check(sensor: SensorDescription, options: PrintOptions, process: str) -> None:
    pattern = sensor.pattern
    if process not in PROCESSES:
        raise ParameterError(f"process: found {process!r}, expected one of {', '.join(PROCESSES)}")
    if options.pattern_type not in PATTERN_TYPES:
        expected = f"expected one of {', '.join(PATTERN_TYPES)}"
        raise ParameterError(f"type: found {options.pattern_type!r}, {expected}")
    if not 0 < options.dot_diameter < 1:
        expected = "expected a share of the pitch, more than 0 and less than 1"
        raise ParameterError(f"dot diameter: found {options.dot_diameter:g}, {expected}")
    for name in ("margin", "bleed"):
        if not getattr(options, name) >= 0:
            found = f"found {getattr(options, name) * 1e3:g} mm"
            raise ParameterError(f"{name}: {found}, expected 0 mm or more")
    _check_gain(pattern, options)
    _check_surface(sensor, options.margin + options.bleed)


def _check_gain(pattern: Pattern, options: PrintOptions) -> None:
    """What is printed must not vanish: half a checker, a dot's radius or half the gap of dots."""
    share = 1.0
    if options.pattern_type == "dmp":
        share = 1 - options.dot_diameter if options.invert else options.dot_diameter
    most = share * pattern.pitch / 2
    if not 0 <= options.ink_gain < most:
        expected = f"expected 0 to less than {most * 1e6:.4g} um, where nothing is left"
        raise ParameterError(f"ink gain: found {options.ink_gain * 1e6:g} um, {expected}")
    # Light ink outside the checkers is a frame of margin and bleed, narrowed from both sides.
    frame = options.margin + options.bleed
    if options.invert and options.pattern_type == "cmp" and 0 < options.ink_gain >= frame / 2:
        found = f"found {options.ink_gain * 1e6:g} um on inverted ink"
        expected = f"expected 0, or less than half of margin and bleed, {frame * 1e6 / 2:.4g} um"
        raise ParameterError(f"ink gain: {found}, {expected}")


def _check_surface(sensor: SensorDescription, around: float) -> None:
    pattern, surface = sensor.pattern, sensor.pattern.surface
    size = np.array([pattern.cols + 1, pattern.rows + 1]) * pattern.pitch + 2 * around
    reach: NDArray[np.float64] = size / 2
    if surface.type == "plane":
        return
    if surface.type == "sphere_cap":
        needed = float(np.hypot(*reach))
    else:
        needed = float(reach[1 if surface.axis == "x" else 0])
    if not needed < surface.radius:
        raise DescriptionError(
            f"{sensor.origin}: pattern.surface.radius: found {surface.radius * 1e3:.6g} mm, "
            f"expected more than {needed * 1e3:.6g} mm, as far as the print of "
            f"{size[0] * 1e3:.6g} x {size[1] * 1e3:.6g} mm reaches, margin and bleed included"
        )
