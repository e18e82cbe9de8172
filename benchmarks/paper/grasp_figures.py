"""The figures of V.D: forces over time, tracks at the knock, where the force acts, all knocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from paper import figure_style
from paper.experiment import Arrays, number
from paper.grasp_scores import LIMIT, STAGES, GraspScore, frames_of
from paper.knock_scores import KnockScore
from paper.method import Method

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_distributions", "draw_forces", "draw_knocks", "draw_tracks"]

SHADES = {"clamping": "#eef3e2", "disturbance": "#f6e3dc", "release": "#e3ecf6"}
MM = 1e3
# Around the markers of the crop, px.
MARGIN = 12
ARROW_STEP = 2
# Axes reach this far from 0, N or N mm, so that noise alone does not fill them.
LEAST_SPAN = 0.1


def draw_forces(
    film: Arrays, scores: Mapping[Method, GraspScore], path: Path, draw: int = 0
) -> Path:
    """Force, moment and share of wrong numbers over time, of one draw of the noise."""
    import matplotlib.pyplot as plt

    figure_style.apply()
    figure, axes = plt.subplots(4, 2, figsize=(figure_style.WIDTH_IN, 8.2), sharex=True)
    time = np.arange(len(film["phase"])) / number(film, "rate")
    true = film["true_wrench"]
    quantities = _quantities(true)
    for axis, (label, truth) in zip(axes.flat, quantities, strict=False):
        axis.plot(time, truth, color=figure_style.TRUE_COLOUR, linewidth=3.5, alpha=0.3)
        axis.set_ylabel(label)
    for method, score in scores.items():
        style: dict[str, Any] = {
            "color": figure_style.COLOURS[method.key],
            "linestyle": figure_style.LINES[method.key],
            "linewidth": 1.2,
        }
        for axis, (_, values) in zip(axes.flat, _quantities(score.wrench[draw]), strict=False):
            axis.plot(time, values, **style)
        axes[3, 1].plot(time, 100 * score.wrong[draw], label=method.label, **style)
    axes[3, 1].set_ylabel("wrong numbers, %")
    for axis in axes.flat:
        _shade(axis, film, time)
        low, high = axis.get_ylim()
        axis.set_ylim(min(low, -LEAST_SPAN), max(high, LEAST_SPAN))
    for axis in axes[3]:
        axis.set_xlabel("time, s")
    axes[3, 1].plot([], [], color="k", linewidth=3.5, alpha=0.3, label="truth")
    _name_stages(axes[0, 0], film, time)
    figure.legend(*axes[3, 1].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure_style.save(figure, path)


def _quantities(wrench: NDArray[np.float64]) -> list[tuple[str, NDArray[np.float64]]]:
    force, moment = wrench[:, :3], wrench[:, 3:] * MM
    return [
        ("|F|, N", np.linalg.norm(force, axis=1)),
        ("Fx (along the bar), N", force[:, 0]),
        ("Fy, N", force[:, 1]),
        ("Fz, N", force[:, 2]),
        ("Mx, N mm", moment[:, 0]),
        ("My, N mm", moment[:, 1]),
        ("Mz, N mm", moment[:, 2]),
    ]


def _shade(axis: Axes, film: Arrays, time: NDArray[np.float64]) -> None:
    half = (time[1] - time[0]) / 2
    for stage, colour in SHADES.items():
        frames = frames_of(film["phase"], stage)
        axis.axvspan(time[frames[0]] - half, time[frames[-1]] + half, color=colour, zorder=0)
    assert set(SHADES) <= set(STAGES)  # noqa: S101


def _name_stages(axis: Axes, film: Arrays, time: NDArray[np.float64]) -> None:
    for stage in SHADES:
        middle = float(time[frames_of(film["phase"], stage)].mean())
        axis.annotate(
            stage,
            (middle, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=8,
        )


def draw_tracks(films: Mapping[Method, Arrays], path: Path) -> Path:
    """The left view at the knock, with true and matched tracks from the frame before."""
    import matplotlib.pyplot as plt

    figure_style.apply()
    figure, axes = plt.subplots(
        1, len(films), figsize=(figure_style.WIDTH_IN, 4.6), layout="constrained"
    )
    for axis, (method, film) in zip(axes, films.items(), strict=True):
        axis.imshow(film["crop"], cmap="gray", vmin=0, vmax=330)
        _tracks(axis, film["true_before"], film["true_after"], "#009E73", "true")
        colour = figure_style.COLOURS["dmp_nearest"]
        before, after = film[f"{method.key}.before"], film[f"{method.key}.after"]
        _tracks(axis, before, after, colour, "matched")
        axis.set(title=method.label, xticks=[], yticks=[], **_limits(film["true_after"]))
        axis.grid(visible=False)
        axis.spines[:].set_visible(False)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure_style.save(figure, path)


def _tracks(
    axis: Axes,
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    colour: str,
    label: str,
) -> None:
    a, b = before.reshape(-1, 2), after.reshape(-1, 2)
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    ends = np.stack([a[known], b[known], np.full_like(a[known], np.nan)], axis=1).reshape(-1, 2)
    width = 3.2 if label == "true" else 1.1
    axis.plot(ends[:, 0], ends[:, 1], color=colour, linewidth=width, label=f"{label} track")
    axis.plot(b[known, 0], b[known, 1], ".", color=colour, markersize=1.2 * width + 1)


def _limits(corners: NDArray[np.float64]) -> dict[str, tuple[float, float]]:
    low = np.nanmin(corners, axis=(0, 1)) - MARGIN
    high = np.nanmax(corners, axis=(0, 1)) + MARGIN
    return {"xlim": (low[0], high[0]), "ylim": (high[1], low[1])}


def draw_distributions(
    truth: Arrays, measured: Sequence[tuple[Method, Arrays]], path: Path
) -> Path:
    """Pressure and tangential traction in the knock's frame: truth and methods."""
    import matplotlib.pyplot as plt

    figure_style.apply()
    fields = [("truth", *_traction(truth["true_nodes"], truth["true_node_force"]))]
    for method, film in measured:
        nodes, force = film[f"{method.key}.nodes"], film[f"{method.key}.node_force"]
        fields.append((method.label, *_traction(nodes, force)))
    figure, axes = plt.subplots(1, len(fields), figsize=(figure_style.WIDTH_IN, 3.3), sharey=True)
    most = float(np.abs(fields[0][3][..., 2]).max())
    extent = 1.1 * MM * float(np.abs(fields[1][1]).max())
    for axis, (label, x, y, traction) in zip(axes, fields, strict=True):
        mesh = axis.pcolormesh(
            x * MM, y * MM, -traction[..., 2], cmap="RdBu_r", vmin=-most, vmax=most, rasterized=True
        )
        part = np.s_[::ARROW_STEP, ::ARROW_STEP]
        axis.quiver(
            x[part] * MM,
            y[part] * MM,
            *np.moveaxis(traction[part][..., :2], -1, 0),
            scale=12 * most,
            width=0.004,
        )
        axis.set(title=label, xlabel="x, mm", aspect="equal")
        axis.set(xlim=(-extent, extent), ylim=(-extent, extent))
        axis.grid(visible=False)
    axes[0].set_ylabel("y, mm")
    figure.colorbar(mesh, ax=axes, label="pressure, kPa", shrink=0.8)
    return figure_style.save(figure, path)


def _traction(
    nodes: NDArray[np.float64], force: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """x, y (rows, cols) m and traction (rows, cols, 3) kPa of a regular grid of nodes."""
    cols = int(np.argmax(np.diff(nodes[:, 0]) < 0)) + 1
    x, y = (nodes[:, axis].reshape(-1, cols) for axis in (0, 1))
    area = (x[0, 1] - x[0, 0]) * (y[1, 0] - y[0, 0])
    return x, y, force.reshape(*x.shape, 3) / area / 1e3


def draw_knocks(scores: Mapping[Method, KnockScore], path: Path) -> Path:
    """Wrong numbers, lost markers and error of the force over the size of the knock."""
    import matplotlib.pyplot as plt

    figure_style.apply()
    figure, axes = plt.subplots(1, 3, figsize=(figure_style.WIDTH_IN, 3.4), sharex=True)
    labels = (
        "wrong numbers, % of markers",
        "markers not found, %",
        "error of the force, % of the peak",
    )
    for place, (method, score) in enumerate(scores.items()):
        for axis, values in zip(axes, (score.wrong, score.lost, score.force), strict=True):
            axis.plot(
                score.jump,
                100 * np.where(np.isfinite(values), values, np.nan),
                color=figure_style.COLOURS[method.key],
                marker=figure_style.MARKERS[method.key],
                # Those drawn first show around those that lie on them.
                markersize=9.0 - 1.5 * place,
                fillstyle="none",
                linestyle="none",
                label=method.label,
            )
    for axis, label in zip(axes, labels, strict=True):
        axis.set(xlabel="jump of the gel in one frame, pitches", ylabel=label)
        axis.set_ylim(bottom=-1, top=max(10.0, axis.get_ylim()[1]))
    axes[2].axhline(100 * LIMIT, color=figure_style.PAPER_COLOUR, linewidth=0.8)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5)
    return figure_style.save(figure, path)
