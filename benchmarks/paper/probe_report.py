"""What section V.C came to: tables, figures and claims."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from paper.experiment import (
    Arrays,
    Claim,
    Deviation,
    Experiment,
    Figure,
    Report,
    Results,
    Table,
    Text,
)
from paper.probe import HIGH_RESPONSE, PRESSED, cases
from paper.probe_figures import draw_depth_and_gain, draw_maps
from paper.reading_names import name_of
from paper.readings import READINGS

__all__ = ["EXPERIMENT", "claims", "joined_points", "report", "responses", "significantly_more"]

SECTION = "V.C"
DOTS = ("dmp_nearest", "dmp_grid", "dmp_flow")
# "Significantly" of the paper: chance alone would do as well less often than this.
CHANCE = 0.05
# A depth is next to a dividing line within this share of it; many are this share of the points.
NEAR_LINE, MANY = 0.05, 0.1

Array = NDArray[np.float64]


def report(results: Results, folder: Path) -> Report:
    """Captured depths, then what fits make of them."""
    points = joined_points(list(results.values()))
    deepest = 1e3 * points["true"]
    blocks = (
        Text(
            "For each point the marker that went deepest, as in the paper. Under the probe, which "
            f"is {1e3 * PRESSED:g} mm deep, the marker surface itself goes in by "
            f"{deepest.min():.3f} to {deepest.max():.3f} mm: between probe and print lies skin. "
            f"{_reach_of_the_line(points)} The zone is also counted from {HIGH_RESPONSE:.0%} of "
            "what the marker surface does at the point."
        ),
        _depth_table(points),
        Figure(
            draw_maps(points, folder / "probe_maps.png"),
            "Depth of the deepest marker at each point, as Fig. 15 (a) of the paper; circled: at "
            f"least {HIGH_RESPONSE:.0%} of what the marker surface does there. Grey: corners or "
            "dots.",
        ),
        Text(
            "Polynomial: a full quadratic in x and y, least squares, its deepest place sought half "
            "as far out as its markers reach. The paper tells neither degree nor neighbourhood, "
            "and the outcome rests on it, so both plain readings are computed for all methods "
            "alike: the markers in a square of one pitch to each side of the deepest one (of "
            "corners: nine), and the nine markers nearest to it. The dense surface is this "
            "project's own interpolation, without fitting."
        ),
        _gain_table(points),
        Figure(
            draw_depth_and_gain(points, folder / "probe_gain.png"),
            "Left: depth of the deepest marker over the way from the point to the nearest corner. "
            "Right: gain over the deepest marker, mean and all points, as Fig. 15 (c); black "
            "bars: the gain that would reach the marker surface's own depth.",
        ),
        Text(_finding(points)),
    )
    return Report(blocks, claims(points), _deviations(points))


def joined_points(parts: Sequence[Arrays]) -> dict[str, Array]:
    """All points: arrays of `captured_at` one behind the other."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def responses(points: Arrays, key: str) -> tuple[float, float, float]:
    """Mean depth, m; share of points in the paper's zone; in that of the marker surface."""
    depth = points[f"{key}_depth"]
    of_true = depth >= HIGH_RESPONSE * points["true"][:, None]
    return (
        float(depth.mean()),
        float((depth >= HIGH_RESPONSE * PRESSED).mean()),
        float(of_true.mean()),
    )


def gain(points: Arrays, key: str, way: str) -> tuple[float, float]:
    """Mean gain over the deepest marker; RMS of what is left to the marker surface's depth, m."""
    fitted = points[f"{key}_{way}"]
    left = fitted - points["true"][:, None]
    return float((fitted - points[f"{key}_depth"]).mean()), float(np.sqrt((left**2).mean()))


def _reach_of_the_line(points: Arrays) -> str:
    """Where the paper's dividing line can be reached at all."""
    within = float((points["true"] >= HIGH_RESPONSE * PRESSED).mean())
    line = f"{HIGH_RESPONSE:.0%} of the probe's depth or {1e3 * HIGH_RESPONSE * PRESSED:.2g} mm"
    reached = "at no point" if within == 0 else f"at {within:.0%} of the points"
    return f"It reaches the paper's dividing line, {line}, {reached}."


def _depth_table(points: Arrays) -> Table:
    rows = []
    for reading in READINGS:
        mean, paper_zone, true_zone = responses(points, reading.key)
        share = points[f"{reading.key}_depth"] / points["true"][:, None]
        rows.append(
            (
                name_of(reading),
                f"{1e3 * mean:.3f}",
                f"{mean / PRESSED:.0%}",
                f"{share.mean():.0%}",
                f"{share.min():.0%}",
                f"{paper_zone:.0%}",
                f"{true_zone:.0%}",
            )
        )
    count, noises = points["cmp_depth"].shape
    return Table(
        (
            "markers",
            "mean depth, mm",
            "of 0.5 mm",
            "of the marker surface's",
            "least",
            "points from 0.3 mm on",
            "points from 60 % of the marker surface's on",
        ),
        tuple(rows),
        f"Depth of the deepest marker at {count} points, {noises} noises.",
    )


def _gain_table(points: Arrays) -> Table:
    rows = []
    for reading in READINGS:
        cells = [name_of(reading)]
        _, before = gain(points, reading.key, "depth")
        cells.append(f"{1e3 * before:.3f}")
        for way in ("square", "nearest", "dense"):
            more, left = gain(points, reading.key, way)
            fitted = float(points[f"{reading.key}_{way}"].mean())
            cells.append(f"{1e3 * more:+.3f} ({1e3 * fitted:.3f}; {1e3 * left:.3f})")
        rows.append(tuple(cells))
    return Table(
        (
            "markers",
            "deepest marker, RMS off, mm",
            "quadratic, square of a pitch, mm",
            "quadratic, nine nearest, mm",
            "dense surface, mm",
        ),
        tuple(rows),
        "Mean gain over the deepest marker; in brackets the mean depth that comes out and its RMS "
        "error against the deepest place of the marker surface.",
    )


def _finding(points: Arrays) -> str:
    mean = {r.key: 1e3 * responses(points, r.key)[0] for r in READINGS}
    apart = 1e3 * max(abs(mean[key] - mean["cmp_corners"]) for key in DOTS)
    most = 1e3 * max(mean["cmp"] - mean[key] for key in DOTS)
    return (
        f"Without its virtual markers CMP captures {mean['cmp_corners']:.3f} mm on average, "
        f"at most {apart:.1f} um more or less than any DMP, whose dots lie at the same places. "
        f"With them it is {mean['cmp']:.3f} mm, up to {most:.1f} um more than DMP. The deepest of "
        "more markers is never less deep, be it by noise alone: exact virtual markers capture "
        f"{mean['exact']:.3f} mm, so that {1e3 * (mean['cmp'] - mean['exact']):+.1f} um of CMP's "
        f"depth are errors of measurement. {_near_the_line(points)}{_fits(points)}"
    )


def _near_the_line(points: Arrays) -> str:
    """What the paper's DMP next to the lower dividing line makes of the shares beyond it."""
    share = points[f"{DOTS[0]}_depth"] / (HIGH_RESPONSE * points["true"][:, None])
    near = float((np.abs(share - 1) < NEAR_LINE).mean())
    if near < MANY:
        return ""
    return (
        f"{near:.0%} of DMP's points lie within {NEAR_LINE:.0%} of the lower dividing line, so its "
        "share of points beyond it says less than the mean depth. "
    )


def _fits(points: Arrays) -> str:
    """What the polynomials do to CMP, and how far each way is off."""
    ways = {"square": "square of a pitch", "nearest": "nine nearest", "dense": "dense surface"}
    told = []
    for way, name in ways.items():
        more, left = gain(points, "cmp", way)
        told.append(f"{name} {1e3 * more:+.3f} mm, then {1e3 * left:.3f} mm off")
    _, before = gain(points, "cmp", "depth")
    return (
        f"CMP's deepest marker is {1e3 * before:.3f} mm RMS off the marker surface's depth; what "
        f"is gained on average, and RMS what is left: {'; '.join(told)}."
    )


def claims(points: Arrays) -> tuple[Claim, ...]:
    """The paper's claims beside what all points came to."""
    return (*_claims_of_depth(points), *_claims_of_gain(points))


def _claims_of_depth(points: Arrays) -> Iterator[Claim]:
    by_key = {r.key: responses(points, r.key) for r in READINGS}
    dots = [max(by_key[key][n] for key in DOTS) for n in range(3)]
    mean, paper_zone, true_zone = by_key["cmp"]
    of_probe = np.full_like(points["true"], PRESSED)
    yield Claim(
        SECTION,
        "mean captured depth of CMP is nearer to the probe's than that of DMP",
        "nearer, no figure",
        f"{1e3 * mean:.3f} mm, DMP at best {1e3 * dots[0]:.3f} mm, of 0.5 mm",
        abs(PRESSED - mean) < abs(PRESSED - dots[0]),
    )
    yield Claim(
        SECTION,
        "more points in the high-response zone, from 60 % of the probe's depth on",
        "significantly more",
        f"{paper_zone:.0%}, DMP at best {dots[1]:.0%}; the marker surface itself "
        f"{(points['true'] >= HIGH_RESPONSE * PRESSED).mean():.0%}",
        all(significantly_more(points, key, of_probe) for key in DOTS),
    )
    yield Claim(
        SECTION,
        "the same, from 60 % of the marker surface's own depth on",
        "significantly more, of the probe's depth",
        f"{true_zone:.0%}, DMP at best {dots[2]:.0%}",
        all(significantly_more(points, key, points["true"]) for key in DOTS),
    )


def significantly_more(points: Arrays, dots: str, full: Array) -> bool:
    """Whether more points are in the zone with CMP than with a DMP, by more than chance.

    full (P,) m: depth that the zone is a share of.  Sign test over the points at which one of both
    is in the zone by the mean depth of all noises, and the other is not.
    """
    ours, theirs = (
        points[f"{key}_depth"].mean(axis=1) >= HIGH_RESPONSE * full for key in ("cmp", dots)
    )
    won, lost = int((ours & ~theirs).sum()), int((theirs & ~ours).sum())
    if not won + lost:
        return False
    return bool(binomtest(won, won + lost, alternative="greater").pvalue < CHANCE)


def _claims_of_gain(points: Arrays) -> Iterator[Claim]:
    for way, label in (("square", "a square of one pitch"), ("nearest", "the nine nearest")):
        ours = gain(points, "cmp", way)[0]
        best = max(gain(points, key, way)[0] for key in DOTS)
        yield Claim(
            SECTION,
            f"mean gain by polynomial correction is larger for CMP; markers of {label}",
            "larger, no figure",
            f"{1e3 * ours:+.3f} mm; DMP at best {1e3 * best:+.3f} mm",
            # What takes away from the depth is no gain, even if DMP loses more.
            ours > max(best, 0.0),
        )


def _deviations(points: Arrays) -> tuple[Deviation, ...]:
    return (
        Deviation(
            "gel of the probe",
            "PDMS with a skin of silicone, moduli and thickness not told",
            "0.5 MPa, skin of 0.3 mm",
            "the skin's thickness decides how much of the probe's depth reaches the print",
        ),
        Deviation(
            "places",
            "25 at equal intervals, not told",
            f"{len(points['points'])} points on a lattice of 2.475 mm, each on a contact node",
            "all points are resolved alike; they lie at three distances from a gridline along "
            "each axis",
        ),
        Deviation(
            "edge of the probe",
            "not told",
            "rounded by 0.1 mm",
            "stress at a sharp edge has no bound",
        ),
        Deviation(
            "true surface",
            "a real gel",
            "linear, contact nodes 0.275 mm apart, marker surface known every 0.4 mm and a "
            "bicubic spline between",
            "nodes 0.11 mm apart change the deepest place of the marker surface by 4 %; the "
            "spline rounds the dent off, for every method alike",
        ),
    )


EXPERIMENT = Experiment(
    key="probe",
    section=SECTION,
    title="Response to a probe of 0.6 mm",
    cases=cases,
    report=report,
)
