"""What section V.C came to: tables, figures and claims."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
from paper.readings import READINGS

__all__ = ["EXPERIMENT", "claims", "joined_points", "report", "responses"]

SECTION = "V.C"
DOTS = ("dmp_nearest", "dmp_grid", "dmp_flow")

Array = NDArray[np.float64]


def report(results: Results, folder: Path) -> Report:
    """Captured depths, then what fits make of them."""
    points = joined_points(list(results.values()))
    deepest = 1e3 * points["true"]
    blocks = (
        Text(
            "For each point the marker that went deepest, as in the paper. Under the probe, which "
            f"is {1e3 * PRESSED:g} mm deep, the marker surface itself goes in by "
            f"{deepest.min():.3f} to {deepest.max():.3f} mm: between probe and print lie 0.3 mm of "
            f"skin. The paper's dividing line, {HIGH_RESPONSE:.0%} of the probe's depth or "
            f"{1e3 * HIGH_RESPONSE * PRESSED:.2g} mm, is beyond what any marker can show here; so "
            f"the zone is also counted from {HIGH_RESPONSE:.0%} of what the marker surface does at "
            "the point."
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


def _depth_table(points: Arrays) -> Table:
    rows = []
    for reading in READINGS:
        mean, paper_zone, true_zone = responses(points, reading.key)
        share = points[f"{reading.key}_depth"] / points["true"][:, None]
        rows.append(
            (
                reading.label,
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
        cells = [reading.label]
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
    fits = ("square", "nearest")
    by_fit = {way: 1e3 * gain(points, "cmp", way)[1] for way in fits}
    dense = 1e3 * gain(points, "cmp", "dense")[1]
    return (
        f"Without its virtual markers CMP captures {mean['cmp_corners']:.3f} mm on average, within "
        f"{apart:.1f} um of every DMP: corners and dots lie at the same places, so the whole "
        f"advantage, {mean['cmp'] - mean['cmp_corners']:.3f} mm on average, is that of the virtual "
        "markers: one of them is always nearer to the probe. "
        f"{_near_the_line(points):.0f} % of DMP's points lie within 5 % of the lower dividing "
        "line, so its share of points beyond it says less than the mean depth. A quadratic "
        "through a square of a pitch flattens so narrow a dent, the more so the more markers it "
        "has to pass; through the nine nearest markers it follows CMP's closely spaced ones. "
        "Against the marker surface "
        f"CMP is off by {by_fit['square']:.3f} and {by_fit['nearest']:.3f} mm RMS with the two "
        f"fits, by {dense:.3f} mm with the dense surface."
    )


def _near_the_line(points: Arrays) -> float:
    """Percentage of the points of the paper's DMP whose depth is next to the dividing line."""
    share = points[f"{DOTS[0]}_depth"] / (HIGH_RESPONSE * points["true"][:, None])
    return 100 * float((np.abs(share - 1) < 0.05).mean())


def claims(points: Arrays) -> tuple[Claim, ...]:
    """The paper's claims beside what all points came to."""
    by_key = {r.key: responses(points, r.key) for r in READINGS}
    means, paper_zone, true_zone = (
        {key: value[n] for key, value in by_key.items()} for n in range(3)
    )
    dots = [max(values[key] for key in DOTS) for values in (means, paper_zone, true_zone)]
    told = [
        Claim(
            SECTION,
            "mean captured depth of CMP is nearer to the probe's than that of DMP",
            "nearer, no figure",
            f"{1e3 * means['cmp']:.3f} mm, DMP at best {1e3 * dots[0]:.3f} mm, of 0.5 mm",
            means["cmp"] > dots[0],
        ),
        Claim(
            SECTION,
            "more points in the high-response zone, from 60 % of the probe's depth on",
            "significantly more",
            f"{paper_zone['cmp']:.0%}, DMP at best {dots[1]:.0%}; the marker surface itself "
            f"{(points['true'] >= HIGH_RESPONSE * PRESSED).mean():.0%}",
            paper_zone["cmp"] > dots[1],
        ),
        Claim(
            SECTION,
            "the same, from 60 % of the marker surface's own depth on",
            "no figure",
            f"{true_zone['cmp']:.0%}, DMP at best {dots[2]:.0%}",
            true_zone["cmp"] > dots[2],
        ),
    ]
    for way, label in (("square", "a square of one pitch"), ("nearest", "the nine nearest")):
        ours = gain(points, "cmp", way)[0]
        theirs = sorted(gain(points, key, way)[0] for key in DOTS)
        told.append(
            Claim(
                SECTION,
                f"mean gain by polynomial correction is larger for CMP; markers of {label}",
                "larger, no figure",
                f"{1e3 * ours:+.3f} mm; DMP at best {1e3 * theirs[-1]:+.3f} mm",
                # What takes away from the depth is no gain, even if DMP loses more.
                ours > max(theirs[-1], 0.0),
            )
        )
    return tuple(told)


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
