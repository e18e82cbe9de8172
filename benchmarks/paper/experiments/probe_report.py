"""What section V.C came to: tables, figures and claims."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.stats import binomtest

from paper import figure_style
from paper.blocks import Claim, Figure, Report, Table, deviations, prose
from paper.experiment import Arrays, Experiment, Results
from paper.experiments.probe import HIGH_RESPONSE, PRESSED, cases
from paper.readings import READINGS, name_of

SECTION = "V.C"
DOTS = ("dmp_nearest", "dmp_grid", "dmp_flow")
# "Significantly" of the paper: chance alone would do as well less often than this.
CHANCE = 0.05

Array = NDArray[np.float64]


def report(results: Results, folder: Path) -> Report:
    """Captured depths, then what fits make of them."""
    points = joined_points(list(results.values()))
    deepest = 1e3 * points["true"]
    blocks = (
        prose(
            "probe",
            "setup",
            pressed=1000.0 * PRESSED,
            least=deepest.min(),
            most=deepest.max(),
            zone=HIGH_RESPONSE,
        ),
        _depth_table(points),
        Figure(
            draw_maps(points, folder / "probe_maps.png"),
            "Depth of the deepest marker at each point, as Fig. 15 (a) of the paper; circled: at "
            f"least {HIGH_RESPONSE:.0%} of what the marker surface does there. Grey: corners or "
            "dots.",
        ),
        prose("probe", "polynomial"),
        _gain_table(points),
        Figure(
            draw_depth_and_gain(points, folder / "probe_gain.png"),
            "Left: depth of the deepest marker over the way from the point to the nearest corner. "
            "Right: gain over the deepest marker, mean and all points, as Fig. 15 (c); black "
            "bars: the gain that would reach the marker surface's own depth.",
        ),
    )
    return Report(blocks, claims(points), deviations("probe", points=len(points["points"])))


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


EXPERIMENT = Experiment(
    key="probe",
    section=SECTION,
    title="Response to a probe of 0.6 mm",
    cases=cases,
    report=report,
)


PANELS = (
    ("cmp", "CMP, with virtual markers"),
    ("cmp_paper", "CMP, the paper's algorithm"),
    ("cmp_corners", "CMP, corners only"),
    ("dmp_nearest", "DMP, nearest dot"),
)
COLOUR_OF = {"cmp_corners": "cmp"}
WAYS = (
    ("square", "quadratic,\nsquare"),
    ("nearest", "quadratic,\nnine nearest"),
    ("dense", "dense\nsurface"),
)
LIMIT_MM = 6.0


def draw_maps(points: Arrays, path: Path) -> Path:
    """Depth of the deepest marker at each point, one panel for each method."""
    figure, panels = figure_style.panels(2, 2, 7.6, sharex=True, sharey=True)
    x, y = 1e3 * points["points"].T
    true = points["true"]
    low = 1e3 * min(float(points[f"{key}_depth"].min()) for key, _ in PANELS)
    image: Any = None
    for axes, (key, title) in zip(panels.flat, PANELS, strict=True):
        depth = points[f"{key}_depth"].mean(axis=1)
        grid_x, grid_y = 1e3 * points["corner_xy"][0].T
        axes.plot(grid_x, grid_y, ".", color="#bbbbbb", markersize=1.5)
        image = axes.scatter(x, y, c=1e3 * depth, s=130, vmin=0.95 * low, vmax=1e3 * true.max())
        high = depth >= HIGH_RESPONSE * true
        axes.scatter(x[high], y[high], s=230, facecolors="none", edgecolors="black", linewidths=1.1)
        for place in zip(x, y, 1e3 * depth, strict=True):
            axes.annotate(
                f"{place[2]:.2f}",
                place[:2],
                xytext=(0, -14),
                ha="center",
                va="center",
                textcoords="offset points",
                fontsize=6.5,
            )
        axes.set_title(
            f"{title}: {high.sum()} of {len(high)}, mean {1e3 * depth.mean():.3f} mm", fontsize=8.5
        )
        axes.set(xlim=(-LIMIT_MM, LIMIT_MM), ylim=(-LIMIT_MM, LIMIT_MM), aspect="equal")
        axes.grid(visible=False)
    for axes in panels[-1]:
        axes.set_xlabel("x, mm")
    for axes in panels[:, 0]:
        axes.set_ylabel("y, mm")
    figure.colorbar(image, ax=panels, label="depth of the deepest marker, mm", shrink=0.8)
    return figure_style.save(figure, path)


def draw_depth_and_gain(points: Arrays, path: Path) -> Path:
    """Depth over the distance to a corner; gains by method and way."""
    figure, (left, right) = figure_style.panels(1, 2, 3.9, width_ratios=(1, 1.35))
    _draw_depth(left, points)
    _draw_gain(right, points)
    return figure_style.save(figure, path)


def _draw_depth(axes: Axes, points: Arrays) -> None:
    away, true = 1e3 * points["corner"], points["true"]
    axes.plot(
        away, 1e3 * true, "_", color=figure_style.TRUE_COLOUR, markersize=9, label="marker surface"
    )
    for key, label in PANELS:
        depth = 1e3 * points[f"{key}_depth"].mean(axis=1)
        axes.plot(away, depth, linestyle="none", label=label, **_look(key))
    lines = {"--": HIGH_RESPONSE * PRESSED, ":": HIGH_RESPONSE * true.mean()}
    whose = {"--": "60 % of the probe's", ":": "60 % of the marker surface's"}
    for line, depth in lines.items():
        axes.axhline(
            1e3 * depth,
            linestyle=line,
            linewidth=1,
            color=figure_style.PAPER_COLOUR,
            label=whose[line],
        )
    axes.set(xlabel="from the point to the nearest corner, mm", ylabel="deepest marker, mm")
    axes.set_ylim(bottom=0)
    axes.set_xlim(left=0)
    axes.legend(fontsize=7.5, loc="lower left")


def _draw_gain(axes: Axes, points: Arrays) -> None:
    for place, (way, _) in enumerate(WAYS):
        for number, (key, _) in enumerate(PANELS):
            depth = points[f"{key}_depth"]
            gains = 1e3 * (points[f"{key}_{way}"] - depth).mean(axis=1)
            wanted = 1e3 * (points["true"] - depth.mean(axis=1)).mean()
            at = place + 0.17 * (number - 1.5)
            style = _look(key)
            small = {**style, "linestyle": "none", "markersize": 3, "alpha": 0.5}
            axes.plot(np.full(len(gains), at), gains, **small)
            ends = [at - 0.055, at + 0.055]
            axes.plot(ends, [gains.mean()] * 2, linewidth=3, color=style["color"])
            axes.plot(ends, [wanted] * 2, color="black", linewidth=1)
    axes.axhline(0.0, color=figure_style.PAPER_COLOUR, linewidth=1)
    axes.set_xticks(range(len(WAYS)), [label for _, label in WAYS])
    axes.grid(visible=False, axis="x")
    axes.set_ylabel("gain over the deepest marker, mm")


def _look(key: str) -> dict[str, Any]:
    colour = COLOUR_OF.get(key, key)
    hollow = key in COLOUR_OF
    return {
        "color": figure_style.COLOURS[colour],
        "marker": figure_style.MARKERS[colour],
        "markerfacecolor": "white" if hollow else figure_style.COLOURS[colour],
    }
