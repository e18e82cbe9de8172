"""What a calibration found out, and whether it may be used."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.map_fit import MapFit
from cmp_tactile_processing.errors import Finding, errors_in
from cmp_tactile_processing.geometry.rectification import ViewCameraInfo
from cmp_tactile_processing.geometry.rig_parameters import RigParameters
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.yaml_file import read_yaml


@cache
def finding_texts() -> dict[str, dict[str, str]]:
    """Text and advice of every finding of calibrations, by its name: those of findings.yaml."""
    return dict(read_yaml(Path(__file__).with_name("findings.yaml")).content)


def finding(name: str, /, *, error: bool, **values: Any) -> Finding:
    """The finding of that name with these values in its texts; a warning unless it is an error."""
    texts = finding_texts()[name]
    return Finding.graded(*(texts[k].format_map(values) for k in ("text", "advice")), error=error)


def number_text(value: float, digits: int = 3) -> str:
    """A number as people read it: so many digits count, and no power of ten."""
    if not np.isfinite(value):
        return f"{value}"
    return np.format_float_positional(float(f"{value:.{digits}g}"), trim="-")


def length_text(length: float, digits: int = 3) -> str:
    """A length (m) as people read it."""
    if abs(length) < 1e-3:
        return f"{number_text(length * 1e6, digits)} um"
    return f"{number_text(length * 1e3, digits)} mm"


def value_text(value: float, unit: str) -> str:
    """A figure as people read it; without a unit it is a share."""
    if unit == "m":
        return length_text(value)
    if unit == "rad":
        return f"{number_text(float(np.degrees(value)), 2)} deg"
    return f"{number_text(value)} {unit}" if unit else f"{value:.2%}"


class WithFindings:
    """A result that findings speak against, or do not."""

    findings: tuple[Finding, ...]
    verdict: str

    @property
    def accepted(self) -> bool:
        """Whether nothing speaks against using it."""
        return not errors_in(self.findings)


@dataclass(frozen=True)
class Estimate:
    """One parameter before and after, with its standard deviation, in `unit`.

    name: such as "camera.fx", "views.left.mirror.distance", "gel: turn about x".
    determined: False where the data did not determine it and it kept what was known before.
    """

    name: str
    unit: str
    before: float
    after: float
    std: float
    determined: bool


def rig_estimates(parameters: RigParameters, fit: MapFit) -> tuple[Estimate, ...]:
    """All optical values before and after, of a fit of the free ones."""
    found = {
        name: (float(value), float(std), bool(determined))
        for name, value, std, determined in zip(
            parameters.names, fit.values, fit.std, fit.determined, strict=True
        )
    }
    estimates = []
    for item in parameters.all:
        change, std, determined = found.get(item.name, (0.0, 0.0, False))
        after, std = item.before + item.scale * change, abs(item.scale) * std
        estimates.append(Estimate(item.name, item.unit, item.before, after, std, determined))
    return tuple(estimates)


def provenance(estimates: Iterable[Estimate], held: Iterable[str] = ()) -> dict[str, Any]:
    """What a description's record says of any calibration.  held: what else kept its value."""
    items = tuple(estimates)
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "determined": tuple(item.name for item in items if item.determined),
        "held": (*held, *(item.name for item in items if not item.determined)),
    }


@dataclass(frozen=True)
class ViewResiduals:
    """Reprojection residuals of one view: measured minus modelled.

    pixels, residuals (N, 2) px of the view; image (N,): which of the images each one is from;
    used (N,): False for outliers that were left out.
    """

    view: str
    pixels: NDArray[np.float64]
    residuals: NDArray[np.float64]
    image: NDArray[np.intp]
    used: NDArray[np.bool_]

    @property
    def rms(self) -> float:
        """Root of the mean squared length of the residuals used, px; NaN without any."""
        lengths2 = (self.residuals[self.used] ** 2).sum(axis=-1)
        return float(np.sqrt(lengths2.mean())) if lengths2.size else float("nan")


def reprojection(residuals: Sequence[ViewResiduals], *, all_corners: bool = False) -> float:
    """Root mean square length of the residuals of all views, px; NaN without any."""
    parts = [item.residuals if all_corners else item.residuals[item.used] for item in residuals]
    lengths2 = (np.concatenate(parts) ** 2).sum(axis=-1)
    return float(np.sqrt(lengths2.mean())) if lengths2.size else float("nan")


@dataclass(frozen=True)
class CalibrationOutcome(WithFindings):
    """Everything that a calibration found out.

    sensor: the description with what was calibrated in it, its `calibration` filled in; None where
    only camera models are known, as of two plain cameras without a gel.
    cameras: camera model of each view, with the stereo rectification in it.
    verdict: one or two sentences for people.
    """

    method: str
    sensor: SensorDescription | None
    cameras: Mapping[str, ViewCameraInfo]
    estimates: tuple[Estimate, ...]
    residuals: tuple[ViewResiduals, ...]
    findings: tuple[Finding, ...] = field(default_factory=tuple)
    verdict: str = ""
