"""What section IV.E came to: tables, figures and claims."""

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
from paper.reading_names import name_of
from paper.readings import MEASURED, READINGS
from paper.resolution import PAIR_DEPTH, cases
from paper.resolution_figures import draw_dips, draw_spheres
from paper.two_contacts import LEAST_DIP, RAYLEIGH_DIP, smallest_told_apart

__all__ = ["EXPERIMENT", "claims", "joined_pairs", "report"]

SECTION = "IV.E"
DOTS = ("dmp_nearest", "dmp_grid", "dmp_flow")
TRUE = "true"
# Figures that differ by less are the same to text and claims.
ALIKE = 0.1

Array = NDArray[np.float64]


def report(results: Results, folder: Path) -> Report:
    """Five spheres first, then pairs."""
    spheres = results["resolution-spheres"]
    pairs = joined_pairs([item for name, item in results.items() if "-pairs" in name])
    figures = (
        Figure(
            draw_spheres(spheres, folder / "resolution_spheres.png"),
            "Five spheres of 1 mm radius, as Fig. 12 of the paper. Top: the marker surface, blue "
            "the markers, red their displacement, drawn four times as long. Middle: depth along "
            "the gel's axis. Below: its error. Circles: the spheres. The same scales throughout.",
        ),
        Figure(
            draw_dips(pairs, folder / "resolution_pairs.png"),
            "Two spheres of 1 mm radius. Left: how far the depth falls between them, mean over all "
            "pairs and noises; shaded: what the exact marker surface does, from the worst to the "
            "best pair. Right: share of pairs told apart by Rayleigh's dip of 26.5 %.",
        ),
    )
    blocks = (
        Text(
            "The depth of all methods is interpolated by the same dense surface; only the markers "
            "differ. `corners only` is the same CMP measurement with its virtual markers left out, "
            "`exact markers` are those of the simulation: what interpolation alone costs."
        ),
        _sphere_table(spheres),
        figures[0],
        Text(
            "Two spheres are told apart where the depth along the line through both, whose place "
            "is given, has a maximum on either side of the middle and falls between them by at "
            "least 26.5 % of the smaller one (Rayleigh's criterion for two points of light). A "
            f"weaker one asks for {100 * LEAST_DIP:.0f} %. The gel blurs by itself: "
            "the first row says what the marker surface shows, a limit for every method."
        ),
        _pair_table(pairs),
        figures[1],
        Text(_finding(spheres, pairs)),
    )
    return Report(blocks, claims(spheres, pairs), _deviations())


def joined_pairs(parts: Sequence[Arrays]) -> dict[str, Array]:
    """Dips of all pairs: `separation` (n,) m, `true` (n,), by reading KEY `KEY_dip` (n, seeds)."""
    joined: dict[str, list[Array]] = {}
    for part in parts:
        at_once = part[TRUE].shape[1]
        joined.setdefault("separation", []).append(np.repeat(part["separation"], at_once))
        joined.setdefault(TRUE, []).append(part[TRUE].ravel())
        for reading in READINGS:
            name = f"{reading.key}_dip"
            joined.setdefault(name, []).append(part[name].reshape(-1, part[name].shape[-1]))
    return {name: np.concatenate(values) for name, values in joined.items()}


def told_apart(pairs: Arrays, key: str, dip: float, share: float = 1.0) -> tuple[float, float]:
    """Separation, m, down to which that share of pairs is told apart; single spheres split.

    key: of a reading, or `true`.
    """
    dips = pairs[TRUE][:, None] if key == TRUE else pairs[f"{key}_dip"]
    told = dips >= dip
    single = pairs["separation"] == 0
    two = ~single
    return (
        smallest_told_apart(pairs["separation"][two], told[two].all(axis=1), share),
        float(told[single].mean()) if single.any() else float("nan"),
    )


def _sphere_table(spheres: Arrays) -> Table:
    rows = []
    for reading in READINGS:
        near, everywhere = (1e6 * spheres[f"{reading.key}_{what}"] for what in ("near", "all"))
        share = spheres[f"{reading.key}_share"].mean(axis=0)
        rows.append(
            (
                name_of(reading),
                f"{near.mean():.3g}",
                f"{everywhere.mean():.3g}",
                *(f"{100 * value:.0f}" for value in share),
            )
        )
    heads = tuple(f"sphere {n + 1}, %" for n in range(5))
    return Table(
        ("markers", "RMS near spheres, um", "RMS everywhere, um", *heads),
        tuple(rows),
        "Error of the reconstructed depth, within a sphere's radius of a centre and everywhere; "
        f"deepest reconstructed place over the true one, by sphere "
        f"({_depths(spheres)} mm deep). Means over noises.",
    )


def _depths(spheres: Arrays) -> str:
    depth = -1e3 * spheres[TRUE][..., 2]
    away = np.linalg.norm(spheres["nodes"][None] - spheres["centres"][:, None, None], axis=-1)
    deepest = [float(depth[one < 1e-3].max()) for one in away]
    return f"{min(deepest):.3f} to {max(deepest):.3f}"


def _pair_table(pairs: Arrays) -> Table:
    rows = []
    labels = [(TRUE, "the marker surface itself")] + [(r.key, name_of(r)) for r in READINGS]
    for key, label in labels:
        least, split = told_apart(pairs, key, LEAST_DIP)
        rayleigh, _ = told_apart(pairs, key, RAYLEIGH_DIP)
        half, _ = told_apart(pairs, key, RAYLEIGH_DIP, 0.5)
        rows.append((label, _mm(rayleigh), _mm(half), _mm(least), f"{100 * split:.0f} %"))
    count = int((pairs["separation"] == pairs["separation"].max()).sum())
    noises = pairs["cmp_dip"].shape[1]
    return Table(
        (
            "markers",
            "dip of 26.5 %: all told apart from, mm",
            "half of them from, mm",
            f"dip of {100 * LEAST_DIP:.0f} %: all from, mm",
            "single spheres taken for two",
        ),
        tuple(rows),
        f"Smallest separation from which on every pair is told apart under every noise: {count} "
        f"pairs at each of {len(np.unique(pairs['separation'])) - 1} separations, {noises} "
        f"draws of noise, {1e3 * PAIR_DEPTH:g} mm deep. Last: single spheres that "
        "show the smaller dip.",
    )


def _finding(spheres: Arrays, pairs: Arrays) -> str:
    near = {r.key: 1e6 * float(spheres[f"{r.key}_near"].mean()) for r in READINGS}
    best = min(DOTS, key=lambda key: near[key])
    apart = {r.key: told_apart(pairs, r.key, RAYLEIGH_DIP)[0] for r in READINGS}
    limit = told_apart(pairs, TRUE, RAYLEIGH_DIP)[0]
    alike = abs(near["cmp_corners"] / near[best] - 1) < ALIKE
    better = near["cmp"] < (1 - ALIKE) * near["cmp_corners"]
    follows = (
        "Corners and dots lie at the same places of the gel and tell the same: what CMP resolves "
        "better comes from its virtual markers, not from how a corner is found. "
        if alike and better
        else ""
    )
    lacks = near["cmp"] > (1 + ALIKE) * near["exact"]
    why = (
        f" Exact virtual markers would be off by {near['exact']:.3g} um. CMP lacks to these what "
        "gridlines along x, the direction from one view to the other, do not tell: both views see "
        "them in the same plane, and their depth between corners rests on a curve through these."
        if lacks
        else ""
    )
    return (
        f"Near the spheres CMP is off by {near['cmp']:.3g} um, by {near['cmp_corners']:.3g} um "
        f"without virtual markers, and the best DMP by {near[best]:.3g} um. {follows}"
        f"Pairs are told apart from {_mm(apart['cmp'])} mm on by CMP, from "
        f"{_mm(apart['cmp_corners'])} mm without virtual markers, from "
        f"{', '.join(_mm(apart[key]) for key in DOTS)} mm by DMP (nearest dot, grid order, "
        f"flow); the marker surface itself shows them from {_mm(limit)} mm on.{why}"
    )


def claims(spheres: Arrays, pairs: Arrays) -> tuple[Claim, ...]:
    """The paper's claims beside what spheres and joined pairs came to."""
    near = {r.key: 1e6 * float(spheres[f"{r.key}_near"].mean()) for r in MEASURED}
    least = {r.key: float(spheres[f"{r.key}_share"].mean(axis=0).min()) for r in MEASURED}
    apart = {r.key: told_apart(pairs, r.key, RAYLEIGH_DIP)[0] for r in MEASURED}
    dots_apart = [apart[key] if np.isfinite(apart[key]) else np.inf for key in DOTS]
    dots_near, dots_least = [near[key] for key in DOTS], [least[key] for key in DOTS]
    limit = told_apart(pairs, TRUE, RAYLEIGH_DIP)[0]
    half = {r.key: told_apart(pairs, r.key, RAYLEIGH_DIP, 0.5)[0] for r in MEASURED}
    dots_half = [half[key] if np.isfinite(half[key]) else np.inf for key in DOTS]
    return (
        Claim(
            SECTION,
            "five spheres: CMP reconstructs the contact surface more finely than DMP",
            "shown as a picture",
            f"depth near the spheres off by {near['cmp']:.3g} um RMS; "
            f"DMP at best {min(dots_near):.3g} um",
            near["cmp"] < (1 - ALIKE) * min(dots_near),
        ),
        Claim(
            SECTION,
            "DMP responds to a sphere only near a marker, CMP also between them",
            "shown as a picture",
            f"least share of a sphere's depth: CMP {100 * least['cmp']:.0f} %, DMP at best "
            f"{100 * max(dots_least):.0f} %",
            least["cmp"] > (1 + ALIKE) * max(dots_least),
        ),
        Claim(
            SECTION,
            "virtual markers improve the resolution",
            "no figure",
            f"two 1 mm spheres told apart from {_mm(apart['cmp'])} mm on, without virtual markers "
            f"{_mm(apart['cmp_corners'])} mm, DMP {_mm(min(dots_apart))} mm at best (half of the "
            f"pairs: {_mm(half['cmp'])}, {_mm(half['cmp_corners'])}, {_mm(min(dots_half))} mm); "
            f"the marker surface itself {_mm(limit)} mm",
            bool(apart["cmp"] < min(dots_apart) and not apart["cmp_corners"] <= apart["cmp"]),
        ),
    )


def _deviations() -> tuple[Deviation, ...]:
    return (
        Deviation(
            "load of the five spheres",
            "50 N",
            "2 N",
            "no silicone carries 10 N on a sphere of 1 mm radius: by Hertz even 2 MPa would give "
            "way by more than its diameter",
        ),
        Deviation(
            "gel under the spheres",
            "modulus, shape and skin not told",
            "22 x 22 x 6 mm, cap of 27 mm radius, 2 MPa, skin of 0.3 mm",
            "the prototype's size; the skin blurs what touches it, for every method alike",
        ),
        Deviation(
            "true surface",
            "Abaqus, mesh not told",
            "linear gel, contact nodes 0.275 mm apart, marker surface known every 0.4 mm and a "
            "bicubic spline between",
            "finer detail than that is in no picture, for every method alike",
        ),
        Deviation(
            "pairs of spheres",
            "none",
            "four pairs at a time, 0.2 mm deep, in directions and places spread evenly over the "
            "grid's cell",
            "a number for resolution, which the paper shows as a picture only",
        ),
    )


def _mm(value: float) -> str:
    return f"{1e3 * value:.1f}" if np.isfinite(value) else "none"


EXPERIMENT = Experiment(
    key="resolution",
    section=SECTION,
    title="Resolution: five small spheres, and pairs of them",
    cases=cases,
    report=report,
)
