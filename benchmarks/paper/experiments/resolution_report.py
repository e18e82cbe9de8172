"""What section IV.E came to: tables, figures and claims."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from numpy.typing import NDArray

from paper import figure_style
from paper.blocks import Claim, Figure, Report, Table, deviations, prose
from paper.experiment import Arrays, Experiment, Results
from paper.experiments.resolution import (
    LEAST_DIP,
    PAIR_DEPTH,
    RADIUS,
    RAYLEIGH_DIP,
    cases,
    smallest_resolved,
)
from paper.readings import MEASURED, READINGS, name_of

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
            "best pair. Right: share of pairs distinguished by Rayleigh's dip of 26.5 %.",
        ),
    )
    blocks = (
        prose("resolution", "setup"),
        _sphere_table(spheres),
        figures[0],
        prose("resolution", "pairs", dip=100 * LEAST_DIP),
        _pair_table(pairs),
        figures[1],
    )
    return Report(blocks, claims(spheres, pairs), deviations("resolution"))


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


def resolved(pairs: Arrays, key: str, dip: float, share: float = 1.0) -> tuple[float, float]:
    """Separation, m, down to which that share of pairs is distinguished; single spheres split.

    key: of a reading, or `true`.
    """
    dips = pairs[TRUE][:, None] if key == TRUE else pairs[f"{key}_dip"]
    data = dips >= dip
    single = pairs["separation"] == 0
    two = ~single
    return (
        smallest_resolved(pairs["separation"][two], data[two].all(axis=1), share),
        float(data[single].mean()) if single.any() else float("nan"),
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
        least, split = resolved(pairs, key, LEAST_DIP)
        rayleigh, _ = resolved(pairs, key, RAYLEIGH_DIP)
        half, _ = resolved(pairs, key, RAYLEIGH_DIP, 0.5)
        rows.append((label, _mm(rayleigh), _mm(half), _mm(least), f"{100 * split:.0f} %"))
    count = int((pairs["separation"] == pairs["separation"].max()).sum())
    noises = pairs["cmp_dip"].shape[1]
    return Table(
        (
            "markers",
            "dip of 26.5 %: all distinguished from, mm",
            "half of them from, mm",
            f"dip of {100 * LEAST_DIP:.0f} %: all from, mm",
            "single spheres taken for two",
        ),
        tuple(rows),
        f"Smallest separation from which on every pair is distinguished under every noise: {count} "
        f"pairs at each of {len(np.unique(pairs['separation'])) - 1} separations, {noises} "
        f"draws of noise, {1e3 * PAIR_DEPTH:g} mm deep. Last: single spheres that "
        "show the smaller dip.",
    )


def claims(spheres: Arrays, pairs: Arrays) -> tuple[Claim, ...]:
    """The paper's claims beside what spheres and joined pairs came to."""
    near = {r.key: 1e6 * float(spheres[f"{r.key}_near"].mean()) for r in MEASURED}
    least = {r.key: float(spheres[f"{r.key}_share"].mean(axis=0).min()) for r in MEASURED}
    apart = {r.key: resolved(pairs, r.key, RAYLEIGH_DIP)[0] for r in MEASURED}
    dots_apart = [apart[key] if np.isfinite(apart[key]) else np.inf for key in DOTS]
    dots_near, dots_least = [near[key] for key in DOTS], [least[key] for key in DOTS]
    limit = resolved(pairs, TRUE, RAYLEIGH_DIP)[0]
    half = {r.key: resolved(pairs, r.key, RAYLEIGH_DIP, 0.5)[0] for r in MEASURED}
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
            f"two 1 mm spheres resolved from {_mm(apart['cmp'])} mm on, without virtual markers "
            f"{_mm(apart['cmp_corners'])} mm, DMP {_mm(min(dots_apart))} mm at best (half of the "
            f"pairs: {_mm(half['cmp'])}, {_mm(half['cmp_corners'])}, {_mm(min(dots_half))} mm); "
            f"the marker surface itself {_mm(limit)} mm",
            bool(apart["cmp"] < min(dots_apart) and not apart["cmp_corners"] <= apart["cmp"]),
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


COLUMNS = (
    ("true", "truth"),
    ("cmp", "CMP"),
    ("cmp_corners", "CMP, corners only"),
    ("dmp_nearest", "DMP, nearest dot"),
)
LINES = (
    ("cmp", "CMP, with virtual markers", "cmp", "-"),
    ("cmp_paper", "CMP, the paper's algorithm", "cmp_paper", "--"),
    ("cmp_corners", "CMP, corners only", "cmp", ":"),
    ("dmp_nearest", "DMP, nearest dot", "dmp_nearest", "-"),
    ("dmp_grid", "DMP, grid order", "dmp_grid", "--"),
    ("dmp_flow", "DMP, optical flow", "dmp_flow", ":"),
)
# The part of the print that is drawn, m, and by how much displacements are exaggerated.
SHOWN = 5.4e-3
EXAGGERATION = 4
ERROR_UM = 60.0


def draw_spheres(spheres: Arrays, path: Path) -> Path:
    """Three rows by method: surface with markers, depth, error."""
    figure = figure_style.blank(7.0)
    cells = figure.add_gridspec(3, len(COLUMNS), height_ratios=(1.0, 1.15, 1.3))
    true, nodes = spheres["true"], spheres["nodes"]
    deepest = 1e3 * float((-true[..., 2]).max())
    flat: list[list[Any]] = [[], []]
    images: list[Any] = [None, None]
    for place, (key, title) in enumerate(COLUMNS):
        field = true if key == "true" else spheres[f"{key}_field"]
        solid: Any = figure.add_subplot(cells[0, place], projection="3d")
        markers = [spheres["corner_xy"]] + ([spheres["virtual_xy"]] if key == "cmp" else [])
        _draw_surface(solid, nodes, field, np.concatenate(markers))
        solid.set_title(title, y=1.12)
        error = 1e6 * (true[..., 2] - field[..., 2])
        panels = (
            (-1e3 * field[..., 2], "viridis", 0.0, deepest),
            (error, "RdBu_r", -ERROR_UM, ERROR_UM),
        )
        for row, (values, colours, low, high) in enumerate(panels):
            axes = figure.add_subplot(cells[row + 1, place])
            style: dict[str, Any] = {"cmap": colours, "vmin": low, "vmax": high, "rasterized": True}
            images[row] = axes.pcolormesh(*(1e3 * nodes.transpose(2, 0, 1)), values, **style)
            _frame(axes, spheres["centres"], last=row == 1, first=place == 0)
            if row == 1 and key != "true":
                near = 1e6 * spheres[f"{key}_near"].mean()
                axes.set_title(f"RMS near spheres {near:.3g} um", fontsize=8.5)
            flat[row].append(axes)
    figure.colorbar(images[0], ax=flat[0], label="depth, mm")
    figure.colorbar(images[1], ax=flat[1], label="error of depth, um")
    return figure_style.save(figure, path)


def draw_dips(pairs: Arrays, path: Path) -> Path:
    """Dip over separation, share distinguished over separation."""
    figure, (left, right) = figure_style.panels(1, 2, 3.9)
    wide = np.unique(pairs["separation"])
    wide = wide[wide > 0]
    of = [pairs["separation"] == value for value in wide]
    _draw_true_dips((left, right), 1e3 * wide, [pairs["true"][rows] for rows in of])
    for key, label, colour, line in LINES:
        style: dict[str, Any] = {
            "color": figure_style.COLOURS[colour],
            "linestyle": line,
            "marker": figure_style.MARKERS[colour],
            "label": label,
            "markerfacecolor": "white" if key == "cmp_corners" else None,
        }
        dips = [pairs[f"{key}_dip"][rows] for rows in of]
        left.plot(1e3 * wide, [100 * np.nanmean(d) for d in dips], **style)
        right.plot(1e3 * wide, [100 * (d >= RAYLEIGH_DIP).mean() for d in dips], **style)
    left.axhline(100 * RAYLEIGH_DIP, color=figure_style.PAPER_COLOUR, linestyle="--", linewidth=1)
    left.annotate(
        "distinguished from here",
        (1e3 * wide[-1], 100 * RAYLEIGH_DIP),
        ha="right",
        va="bottom",
        fontsize=8,
        color=figure_style.PAPER_COLOUR,
    )
    left.set(xlabel="separation of the spheres, mm", ylabel="dip between them, %")
    right.set(xlabel="separation of the spheres, mm", ylabel="pairs distinguished, %")
    right.legend(loc="lower right")
    return figure_style.save(figure, path)


def _draw_true_dips(panels: tuple[Axes, Axes], wide_mm: Array, true: list[Array]) -> None:
    """What the marker surface itself does, by separation."""
    left, right = panels
    style: dict[str, Any] = {"color": figure_style.TRUE_COLOUR}
    least, most = ([100 * end(t) for t in true] for end in (np.min, np.max))
    left.fill_between(wide_mm, least, most, alpha=0.15, linewidth=0, **style)
    style["label"] = "marker surface itself"
    left.plot(wide_mm, [100 * t.mean() for t in true], **style)
    right.plot(wide_mm, [100 * (t >= RAYLEIGH_DIP).mean() for t in true], **style)


def _draw_surface(axes: Any, nodes: Array, field: Array, marker_xy: Array) -> None:
    """The displaced surface, markers on it in blue, their displacement in red."""
    inside = np.abs(nodes[:, 0, 1]) < SHOWN
    part = np.ix_(inside, inside)
    x, y = (1e3 * nodes[part][..., axis] for axis in (0, 1))
    # What is drawn is the displacement alone, not the gel's own curvature.
    z = 1e3 * EXAGGERATION * field[part][..., 2]
    axes.plot_surface(x, y, z, color="#dddddd", linewidth=0, rstride=2, cstride=2, alpha=0.6)
    shown = marker_xy[(np.abs(marker_xy) < SHOWN).all(axis=1)]
    spacing = nodes[0, 1, 0] - nodes[0, 0, 0]
    col, row = np.rint((shown - nodes[0, 0]) / spacing).astype(int).T
    moved = 1e3 * EXAGGERATION * field[row, col]
    # Thousands of markers would hide the surface.
    size = 1.0 if len(shown) < 400 else 3.5
    begin = np.column_stack([1e3 * shown, np.zeros(len(shown))])
    # One line with gaps: thousands of single ones take seconds to draw.
    ways = np.stack([begin, begin + moved, np.full_like(begin, np.nan)], axis=1).reshape(-1, 3)
    axes.plot(*ways.T, color="#D55E00", linewidth=0.9 / size)
    axes.scatter(*(begin + moved).T, s=2.5 / size, color="#0072B2", depthshade=False)
    axes.set_box_aspect((1, 1, 0.3), zoom=1.6)
    axes.view_init(elev=42, azim=-60)
    axes.set_axis_off()


def _frame(axes: Any, centres: Array, *, last: bool, first: bool) -> None:
    for x, y in 1e3 * centres:
        axes.add_patch(Circle((x, y), 1e3 * RADIUS, fill=False, color="black", linewidth=0.7))
    limit = 1e3 * SHOWN
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
    axes.grid(visible=False)
    if last:
        axes.set_xlabel("x, mm")
    else:
        axes.set_xticklabels([])
    if first:
        axes.set_ylabel("y, mm")
    else:
        axes.set_yticklabels([])
