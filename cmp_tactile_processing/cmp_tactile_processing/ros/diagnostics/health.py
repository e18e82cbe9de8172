"""What the results of the last second show of the sensor, for the diagnostics of each stage."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from numpy.typing import NDArray

from cmp_tactile_processing.force.advice import ADVICE, UNUSABLE, flag_names, single_flags
from cmp_tactile_processing.geometry.optics import ViewGeometry
from cmp_tactile_processing.measured import (
    ForceField,
    ForceFlag,
    Grid,
    GridFault,
    MarkerFault,
    Markers3D,
    measured_share,
)
from cmp_tactile_processing.stereo.rig import reprojection_rms
from cmp_tactile_processing.surface.reference_keeping import ReferenceKeeper

FAULT_LEVELS: dict[GridFault, bytes] = {
    # A hand in front of the gel, or a finger in it: what it is made for.
    GridFault.NONE: DiagnosticStatus.OK,
    GridFault.PARTLY_HIDDEN: DiagnosticStatus.OK,
    # Light, dirt or something in the way.
    GridFault.DARK: DiagnosticStatus.WARN,
    GridFault.OVEREXPOSED: DiagnosticStatus.WARN,
    GridFault.NO_CONTRAST: DiagnosticStatus.WARN,
    GridFault.NO_PATTERN: DiagnosticStatus.WARN,
    GridFault.TWO_PATTERNS: DiagnosticStatus.WARN,
    GridFault.AMBIGUOUS: DiagnosticStatus.WARN,
    # The sensor description is not that of this sensor: it does not pass by itself.
    GridFault.OTHER_SIZE: DiagnosticStatus.ERROR,
    GridFault.OTHER_PATTERN: DiagnosticStatus.ERROR,
    GridFault.MIRRORED: DiagnosticStatus.ERROR,
    GridFault.TURNED: DiagnosticStatus.ERROR,
    GridFault.OTHER_COLOURS: DiagnosticStatus.ERROR,
}


class GridHealth:
    """Gathers grids; `close_period` reports those that came since the last call."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._grids = 0
        self._followed = 0
        self._confidence = math.nan
        self._found = math.nan
        self._worst = GridFault.NONE
        self._reason = ""
        self._faulty = 0
        self._numbering = ""

    def add(self, grid: Grid) -> None:
        """Take a grid into account."""
        self._grids += 1
        self._followed += grid.followed
        self._numbering = grid.numbering.value
        self._found = grid.found_fraction
        self._confidence = min(grid.confidence, self._confidence, key=_nan_last)
        self._faulty += grid.fault is not GridFault.NONE
        if grid.reason and FAULT_LEVELS[grid.fault] >= FAULT_LEVELS[self._worst]:
            self._worst, self._reason = grid.fault, grid.reason

    def close_period(self) -> tuple[bytes, str, dict[str, str]]:
        """Level, text and figures of the period: the worst fault and the least confidence.

        The text is empty where nothing was missing; figures of no grid are nan.
        """
        followed = self._followed / self._grids if self._grids else math.nan
        figures = {
            "tracked fraction": f"{self._found:.4f}",
            "confidence": f"{self._confidence:.3f}",
            "followed": f"{followed:.2f}",
            "numbering": self._numbering,
            "fault": self._worst.value,
            "frames with a fault": f"{self._faulty} of {self._grids}",
        }
        level, text = FAULT_LEVELS[self._worst], self._reason
        self._begin()
        return level, text, figures


def _nan_last(value: float) -> float:
    return math.inf if math.isnan(value) else value


class SurfaceHealth:
    """Gathers markers; `close_period` reports those that came since the last call."""

    def __init__(self, views: Mapping[str, ViewGeometry]) -> None:
        self._views = views
        self._last: tuple[Markers3D, Mapping[str, Grid]] | None = None
        self._begin()

    def _begin(self) -> None:
        self._last = None
        self._frames = self._implausible = 0
        self._doubt = ""

    def add(self, markers: Markers3D, grids: Mapping[str, Grid], doubt: str) -> None:
        """Take a frame into account; doubt: why it is implausible, empty where it is not."""
        self._last = markers, grids
        self._frames += 1
        if doubt:
            self._implausible += 1
            self._doubt = doubt

    def close_period(self) -> tuple[str, dict[str, str]]:
        """Doubt, empty where there is none, and figures; those of markers are the last frame's."""
        figures = {"implausible frames": f"{self._implausible} of {self._frames}"}
        if self._last is not None:
            markers, grids = self._last
            gaps = markers.ray_gap[np.isfinite(markers.ray_gap)]
            gap = float(np.median(gaps)) if gaps.size else math.nan
            rms = reprojection_rms(markers, grids, self._views)
            figures |= {
                "tracked fraction": f"{measured_share(markers.status):.4f}",
                "markers without position": _counts(markers),
                "median ray gap (um)": f"{gap * 1e6:.2f}",
                "reprojection (px)": f"{rms:.3f}",
            }
        doubt = self._doubt
        self._begin()
        return doubt, figures


def _counts(markers: Markers3D) -> str:
    faults = [fault for fault in MarkerFault if fault is not MarkerFault.NONE]
    counts = {fault.name.lower(): np.count_nonzero(markers.fault == fault) for fault in faults}
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count) or "none"


def reference_figures(keeper: ReferenceKeeper) -> dict[str, object]:
    """Figures by name; those of rest are of the last frames examined."""
    reference, rest, drift = keeper.reference, keeper.judged, keeper.drift
    figures: dict[str, object] = {
        "reference id": reference.id,
        "reference frames": reference.frames,
        "waiting for a reference": keeper.waiting,
    }
    if rest is not None:
        figures |= {
            "still": rest.still,
            "untouched": rest.untouched,
            "shake (um)": f"{rest.shake * 1e6:.2f}",
            "creep (um)": f"{rest.creep * 1e6:.2f}",
        }
        if rest.shape is not None:
            figures["off the shape at rest (um)"] = f"{rest.shape.bump * 1e6:.1f}"
    if drift is not None:
        figures |= {
            "drift (um)": f"{drift.largest * 1e6:.1f}",
            "drift shift (um)": f"{drift.shift * 1e6:.1f}",
            "drift turn (mrad)": f"{drift.turn * 1e3:.3f}",
            "drift shape (um)": f"{drift.shape * 1e6:.1f}",
        }
    return figures


# The others are reported, but belong to ordinary use.
WARNED_OF = UNUSABLE & ~ForceFlag.BEYOND_MARKERS | ForceFlag.NOT_CONVERGED
# A flag is reported once it holds in this share of a second's fields, and until it holds in less
# than the other: one that comes and goes from frame to frame is reported without a break.
REPORTED_FROM = 0.5
REPORTED_UNTIL = 0.1


class ForceHealth:
    """Gathers force fields; `close_period` reports those that came since the last call."""

    def __init__(self) -> None:
        self._reported = ForceFlag.NONE
        self._last: ForceField | None = None
        self._begin()

    def _begin(self) -> None:
        self._fields = 0
        # Fields by all their flags: to take these apart for each field would cost more.
        self._counts: Counter[int] = Counter()

    def add(self, field: ForceField) -> None:
        """Take a field into account."""
        self._last = field
        self._fields += 1
        self._counts[int(field.flags)] += 1

    def close_period(self) -> tuple[bytes, str, dict[str, str]]:
        """Level, advice and figures; the advice is empty where there is nothing to say.

        A period without fields changes nothing; the figures are the last field's.
        """
        if self._fields:
            self._reported = self._renewed()
        self._begin()
        # What is warned of comes first.
        flags = sorted(single_flags(self._reported), key=lambda flag: not flag & WARNED_OF)
        level = DiagnosticStatus.WARN if self._reported & WARNED_OF else DiagnosticStatus.OK
        return level, "; ".join(ADVICE[flag] for flag in flags), self._figures()

    def _renewed(self) -> ForceFlag:
        flags = ForceFlag.NONE
        for flag in ADVICE:
            count = sum(fields for held, fields in self._counts.items() if held & flag)
            if count >= self._fields * (REPORTED_UNTIL if flag & self._reported else REPORTED_FROM):
                flags |= flag
        return flags

    def _figures(self) -> dict[str, str]:
        figures = {"flags": flag_names(self._reported)}
        field = self._last
        if field is None:
            return figures
        force, moment = np.split(field.wrench_std, 2)
        return figures | {
            "tracked fraction": f"{field.valid_fraction:.4f}",
            "noise scale": f"{field.noise_scale:.2f}",
            "force std (N)": _numbers(force, "{:.3f}"),
            "moment std (N mm)": _numbers(moment * 1e3, "{:.2f}"),
            "contacts": str(len(field.contacts)),
            "slip": field.slip_state.name.lower(),
            "large press corrected": "yes" if field.corrected else "no",
            "relaxation taken out": "yes" if field.relaxed else "no",
        }


def _numbers(values: NDArray[np.float64], form: str) -> str:
    return " ".join(form.format(value) for value in values)
