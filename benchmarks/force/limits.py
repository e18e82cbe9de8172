"""Limits of the force stage, each with what was measured; rows without a limit inform."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partialmethod
from typing import ClassVar

import numpy as np
from cases import ForceCase, load_cases
from errors import (
    COMPONENTS,
    NORMAL_SHARES,
    ErrorBars,
    ForceErrors,
    dependence,
    false_contacts,
    seen_shares,
)
from sweeps import (
    Point,
    by_case,
    by_description,
    by_large_press,
    by_load,
    by_missing,
    by_noise,
    by_smoothing,
    rendered_errors,
)
from tables import Limit, LimitRun

from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.sensor.description import SensorDescription

# Depth at which the corrected model is judged, m, and its limit, share of Fz.
JUDGED_DEPTH, LARGE_PRESS_SHARE = 0.44e-3, 0.025


Sweep = Callable[[ForceModel, list[ForceCase], int], Iterator[Point]]


@dataclass
class ForceRun(LimitRun):
    """Measures all parts."""

    sensor: SensorDescription
    frames: int

    PARTS: ClassVar[tuple[str, ...]] = (
        "case", "load", "noise", "smoothing", "missing", "description", "large_press",
        "certainty", "floor", "rendered",
    )  # fmt: skip

    @cached_property
    def _model(self) -> ForceModel:
        return ForceModel(self.sensor)

    @cached_property
    def _cases(self) -> list[ForceCase]:
        return load_cases(self.sensor)

    def _judged(self, sweep: Sweep) -> Iterator[Limit]:
        for point in sweep(self._model, self._cases, self.frames):
            limits = point.limits
            if limits is None:
                continue
            missed, case = limits.missed(point.errors), point.case
            limit = f"Fz {limits.fz:.3f} Ft {limits.ft:.3f} N"
            limit += "" if np.isnan(limits.torque) else f" {1e3 * limits.torque:g} N mm"
            limit += "" if np.isnan(limits.l2) else f" L2 {100 * limits.l2:g} %"
            text = _text(point.errors, case)
            if not np.isnan(point.outlined):
                text += f" (of the true node forces {100 * point.outlined:+.0f} %)"
            l2, fz = point.oracle
            text += "" if np.isnan(l2) else f" (oracle: Fz {fz:.4f} N L2 {100 * l2:.1f} %)"
            text += f", missed: {', '.join(missed)}" if missed else ""
            text += " (by the oracle as well)" if l2 > limits.l2 or fz > limits.fz else ""
            yield Limit(f"{case.name}, {case.newton:g} N", limit, text, not missed, point.sweep)

    def _informed(self, sweep: Sweep) -> Iterator[Limit]:
        for point in sweep(self._model, self._cases, self.frames):
            case = point.case
            name = f"{case.name}, {case.newton:g} N, {point.condition}"
            yield Limit(name, "-", _text(point.errors, case), None, point.sweep)

    _case = partialmethod(_judged, by_case)
    _load = partialmethod(_judged, by_load)
    _noise = partialmethod(_informed, by_noise)
    _smoothing = partialmethod(_informed, by_smoothing)
    _missing = partialmethod(_informed, by_missing)

    def _description(self) -> Iterator[Limit]:
        yield from self._informed(lambda _, *given: by_description(self.sensor, *given))

    def _large_press(self) -> Iterator[Limit]:
        """A neo-Hookean gel."""
        corrected = False
        for point in by_large_press(self.sensor, min(self.frames, 3)):
            case, judged = point.case, point.condition == "corrected"
            corrected |= judged
            share = point.errors.high("fz") / case.newton
            judged &= case.depth == JUDGED_DEPTH
            what = f"{case.name}, {1e3 * case.depth:.2f} mm, {case.newton:.2f} N, {point.condition}"
            limit = f"Fz {100 * LARGE_PRESS_SHARE:g} %" if judged else "-"
            met = bool(share <= LARGE_PRESS_SHARE) if judged else None
            yield Limit(what, limit, _text(point.errors, case), met, "large press")
        if not corrected:
            yield Limit("corrected", "-", "not available", None, "large press")

    def _certainty(self) -> Iterator[Limit]:
        """Share of errors within 1 and 2 standard deviations; normal ones: 68 % and 95 %."""
        bars = ErrorBars.from_cases(self._model, self._cases, self.frames)
        expected = " / ".join(f"{100 * share:.0f}" for share in NORMAL_SHARES)
        for index, name in enumerate(COMPONENTS):
            yield _shares(f"{name}, within 1 / 2 std, %", bars.wrench[:, index])
        for newton in np.unique(bars.loads):
            chosen = bars.wrench[bars.loads == newton]
            yield _shares(f"wrench at {newton:g} N, %", chosen)
        if len(bars.nodes):
            yield _shares("nodal forces in contact, %", bars.nodes)
        yield Limit("normal errors, %", "-", expected, None, "certainty")
        found = dependence(self._model)
        for what, value in (("frames before", found.history), ("one pixel", found.pixel)):
            text = f"{value:.2f} std"
            yield Limit(f"changed by {what}", "1 std", text, bool(value <= 1.0), "certainty")

    def _floor(self) -> Iterator[Limit]:
        """What noise alone shows, and the smallest load that is seen."""
        for scale, frames in ((1.0, 100 * self.frames), (2.0, 500), (4.0, 500)):
            contacts = false_contacts(self._model, frames, scale)
            met = contacts == 0 if scale == 1 else None
            limit = "0" if scale == 1 else "-"
            what = f"false contacts in {frames} frames, noise x {scale:g}"
            yield Limit(what, limit, str(contacts), met, "floor")
        seen = seen_shares(self._model, self._cases, self.frames)
        text = ", ".join(f"{newton:g} N {100 * share:.0f} %" for newton, share in seen.items())
        yield Limit("frames in which a sphere is seen, by load", "-", text, None, "floor")

    def _rendered(self) -> Iterator[Limit]:
        """From frames of the simulated camera."""
        for error in rendered_errors(self.sensor):
            measured = (
                f"Fz {error.fz:.4f} N (std reported {error.fz_std:.4f}), Ft {error.ft:.4f} N, "
                f"torque {1e3 * error.torque:.3f} N mm"
            )
            name, limit = f"{error.name}, {error.newton:g} N", f"Fz {error.limit:.3f} N"
            yield Limit(name, limit, measured, bool(error.fz <= error.limit), "rendered")


def _shares(name: str, values: np.ndarray) -> Limit:
    """Shares of errors, in deviations, within one and two of them."""
    one, two = (100 * float((np.abs(values) <= count).mean()) for count in (1, 2))
    spread = float(np.sqrt(np.mean(values**2)))
    return Limit(name, "-", f"{one:.0f} / {two:.0f} (RMS {spread:.2f} std)", None, "certainty")


def _text(errors: ForceErrors, case: ForceCase) -> str:
    """Errors that 95 % of the frames stay below, and the mean error of the area in contact."""
    return (
        f"Fz {errors.high('fz'):.4f} N ({100 * errors.high('fz') / case.newton:.2f} %) "
        f"Ft {errors.high('ft'):.4f} N {1e3 * errors.high('torque'):.3f} N mm "
        f"L2 {100 * errors.high('l2'):.1f} % mean area {100 * errors.area.mean():+.0f} %"
    )
