"""IV.D: tables, error maps as Fig. 11, claims."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from paper import figure_style
from paper.blocks import Block, Claim, Figure, Report, Table, Text, deviations, prose
from paper.chain import CMP, Method, largest, root_mean_square
from paper.dot_tracking import DMP_GRID, DMP_NEAREST
from paper.experiment import Arrays, Experiment, Results
from paper.experiments.precision import (
    CENTRES,
    DMP_PLAIN,
    DOT_SIZES,
    METHODS,
    cases,
)
from paper.sequence import DOT_DIAMETER

Array = NDArray[np.float64]

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Split:
    """What errors consist of, RMS in space, m.

    systematic: what all draws of noise share.  random: their spread.
    """

    systematic: float
    random: float


@dataclass(frozen=True)
class Summary:
    """Displacement errors of a method in one state of the gel, m.

    rms, largest (3,) along x, y, z: RMS over markers and draws, mean over draws of the largest.
    inside, outside (3,): RMS of the markers in contact, and of the others.
    measured, wrong: share of the visible markers found, number of those with wrong numbers.
    """

    rms: Array
    largest: Array
    inside: Array
    outside: Array
    measured: float
    wrong: int

    @property
    def space(self) -> float:
        """RMS of the error's length."""
        return float(np.linalg.norm(self.rms))

    @property
    def concentration(self) -> Array:
        """How many times larger errors along x, y, z are in contact than outside of it, (3,)."""
        return self.inside / self.outside

    @property
    def typical_concentration(self) -> float:
        """Geometric mean of `concentration` over the axes: z, where errors are largest, is one."""
        return float(np.exp(np.log(self.concentration).mean()))


def summary_of(data: Arrays, method: Method, phase: int) -> Summary:
    """Of the results of `loads`."""
    errors = np.asarray(data[f"{method.key}_errors"][:, phase], dtype=np.float64)
    inside = np.asarray(data["inside"][phase], dtype=np.bool_)
    visible, found, wrong = data[f"{method.key}_counts"][:, phase].sum(axis=0).tolist()
    return Summary(
        rms=root_mean_square(errors),
        largest=np.mean([largest(draw) for draw in errors], axis=0),
        inside=root_mean_square(errors[:, inside]),
        outside=root_mean_square(errors[:, ~inside]),
        measured=found / visible,
        wrong=wrong,
    )


def split_of(errors: NDArray[np.floating]) -> Split:
    """Of errors (draws, rows, cols, 3) m, two draws or more; markers missing in one are left out.

    The mean over draws still holds a share of the noise, which its spread shows.
    """
    complete = np.isfinite(errors).all(axis=(0, -1))
    known = np.asarray(errors, dtype=np.float64)[:, complete]
    random = known.var(axis=0, ddof=1).sum(axis=-1).mean()
    shared = (known.mean(axis=0) ** 2).sum(axis=-1).mean() - random / len(known)
    return Split(float(np.sqrt(max(shared, 0.0))), float(np.sqrt(random)))


# "Noticeably larger" and "significant concentration" of the paper, as we take them.
NOTICEABLE, CONCENTRATED = 1.1, 1.5


def report(results: Results, folder: Path) -> Report:
    """What the loads show, and what the dots' size does."""
    data: Arrays = {**results["loads_cmp"], **results["loads_dmp"]}
    last = len(data["phase"]) - 1
    summaries = {method.key: summary_of(data, method, last) for method in METHODS}
    blocks: list[Block] = [
        _set_up(data),
        _main_table(summaries, len(data["cmp_errors"])),
        Figure(
            error_maps(data, last, folder / "precision_maps.png"),
            "As the paper's Fig. 11 (d, e): displacement error of every marker under all loads, in "
            "one draw of noise, and the mean of all draws, in which noise fades. Black: the true "
            "outline of the contact. A column has one scale.",
        ),
        *_dots_table(results),
    ]
    return Report(tuple(blocks), claims(summaries), deviations("precision", diameter=DOT_DIAMETER))


def _set_up(data: Arrays) -> Text:
    depth = -float(np.min(data["true"][-1][..., 2])) * 1e3
    share = float(np.mean(data["inside"][-1]))
    force, torque = data["wrench"][-1][:3], data["wrench"][-1][5]
    return prose(
        "precision",
        "setup",
        normal=-force[2],
        tangential=force[0],
        torque=torque * 1000.0,
        depth=depth,
        share=share,
    )


def _main_table(summaries: dict[str, Summary], draws: int) -> Table:
    baseline = summaries[CMP.key]
    rows = []
    for method in METHODS:
        found = summaries[method.key]
        rows.append(
            (
                method.label,
                *(_um(value) for value in found.rms),
                *(_um(value) for value in found.largest),
                f"{found.space / baseline.space:.2f}",
                _times(found.concentration),
                f"{found.measured:.1%} / {found.wrong}",
            )
        )
    return Table(
        (
            "method",
            *(f"RMS {axis}" for axis in AXES),
            *(f"max {axis}" for axis in AXES),
            "RMS / CMP's",
            "in contact / outside: x, y, z",
            "found / wrong",
        ),
        tuple(rows),
        f"Displacement errors under all loads, um; RMS over markers and {draws} draws of noise, "
        "maximum of a draw on average.",
    )


PARTS = ("systematic", "noise", "both", "found / wrong")


def _parts(arrays: Arrays, key: str) -> tuple[str, ...]:
    """Cells of PARTS, of the errors and counts under a key."""
    errors = arrays[f"{key}_errors"][:, 0]
    split, both = split_of(errors), float(np.linalg.norm(root_mean_square(errors)))
    visible, found, wrong = arrays[f"{key}_counts"][:, 0].sum(axis=0).tolist()
    parts = (_um(value) for value in (split.systematic, split.random, both))
    return (*parts, f"{found / visible:.1%} / {wrong}")


def _dots_table(results: Results) -> Iterable[Block]:
    if "dots" not in results:
        return
    data, rows = results["dots"], []
    for size, centres in product(DOT_SIZES, CENTRES):
        rows.append((f"{size:g}", centres, *_parts(data, f"{size:g}_{centres}")))
    yield Table(
        ("dot diameter / pitch", "centres", *PARTS),
        tuple(rows),
        f"{DMP_GRID.label} by dot size under all loads, RMS in space, um: what all draws of noise "
        f"share, and their spread. All other results have {DOT_DIAMETER:g}, which was not chosen "
        "on this contact.",
    )


def claims(summaries: dict[str, Summary]) -> tuple[Claim, ...]:
    """What the paper says of CMP and DMP, beside ours; summaries by the methods' keys.

    Against dots as the paper has them, whose centres are plain, and against the stronger ones.
    """
    return tuple(
        claim for dots in (DMP_PLAIN, DMP_NEAREST) for claim in _claims_against(summaries, dots)
    )


def _claims_against(summaries: dict[str, Summary], method: Method) -> Iterable[Claim]:
    ours, dots = summaries[CMP.key], summaries[method.key]
    for k, axis in enumerate(AXES):
        yield Claim(
            section="IV.D",
            what=f"error in {axis}, CMP against {method.label}",
            paper="RMS and maximum noticeably larger with DMP",
            ours=(
                f"RMS {_um(ours.rms[k])} against {_um(dots.rms[k])} um, maximum "
                f"{_um(ours.largest[k])} against {_um(dots.largest[k])} um"
            ),
            met=bool(
                dots.rms[k] >= NOTICEABLE * ours.rms[k]
                and dots.largest[k] >= NOTICEABLE * ours.largest[k]
            ),
        )
    yield Claim(
        section="IV.D",
        what=f"errors of {method.label} concentrate in the contact",
        paper="significant concentration in the contact region",
        ours=f"RMS in x, y, z {_times(dots.concentration)} times that outside",
        met=dots.typical_concentration >= CONCENTRATED,
    )
    yield Claim(
        section="IV.D",
        what=f"errors of CMP are more uniform than those of {method.label}",
        paper="more uniform",
        ours=(
            f"RMS in contact {_times(ours.concentration)} times that outside (CMP), "
            f"{_times(dots.concentration)} times (DMP)"
        ),
        met=_unevenness(ours) < _unevenness(dots),
    )


def _unevenness(summary: Summary) -> float:
    return float(abs(np.log(summary.typical_concentration)))


def _times(ratios: NDArray[np.float64]) -> str:
    return ", ".join(f"{ratio:.2f}" for ratio in ratios)


def _um(metres: float) -> str:
    return f"{metres * 1e6:.3g}"


EXPERIMENT = Experiment(
    key="precision",
    section="IV.D",
    title="Precision under normal force, tangential force and torque",
    cases=cases,
    report=report,
)


_SHORT = {CMP.key: "CMP", DMP_PLAIN.key: "DMP, plain"}
ERROR_COLOURS = "RdBu_r"


def error_maps(data: Arrays, phase: int, path: Path) -> Path:
    """As Fig. 11 (d, e), a column for each axis; below them the means over draws."""
    rows = _rows_of_maps(data, phase)
    figure, axes = figure_style.panels(len(rows), 3, 10.6, sharex=True, sharey=True, squeeze=False)
    places = data["reference"][0, :, 0] * 1e3, data["reference"][:, 0, 1] * 1e3
    for k, name in enumerate(AXES):
        widest = float(np.nanmax([np.abs(errors[..., k]) for _, errors in rows]))
        scale = {"cmap": ERROR_COLOURS, "vmin": -widest, "vmax": widest, "shading": "nearest"}
        for row, (label, errors) in enumerate(rows):
            axis = axes[row, k]
            drawn = axis.pcolormesh(*places, errors[..., k], **scale)
            _outline(axis, data, phase)
            axis.set_title(f"{name}: RMS {root_mean_square(errors)[k]:.2f} um", fontsize=9)
            axis.set_aspect("equal")
            axis.grid(visible=False)
            if k == 0:
                axis.set_ylabel(f"{label}\ny [mm]")
        axes[-1, k].set_xlabel("x [mm]")
        bar = figure.colorbar(drawn, ax=axes[:, k], location="bottom", shrink=0.9, pad=0.02)
        bar.set_label(f"error in {name} [um]")
    return figure_style.save(figure, path)


def _rows_of_maps(data: Arrays, phase: int) -> list[tuple[str, NDArray[np.float64]]]:
    """Labels, and errors (rows, cols, 3) in um."""
    rows = []
    for method in (CMP, DMP_PLAIN):
        errors = np.asarray(data[f"{method.key}_errors"][:, phase], dtype=np.float64) * 1e6
        rows.append((f"{_SHORT[method.key]}, one draw", errors[0]))
        rows.append((f"{_SHORT[method.key]}, mean of {len(errors)}", errors.mean(axis=0)))
    return [rows[0], rows[2], rows[1], rows[3]]


def _outline(axis: Axes, data: Arrays, phase: int) -> None:
    """Border of the nodes in contact, which lie on a regular grid."""
    x, y = (np.unique(np.round(data["node"][:, k], 9)) for k in (0, 1))
    field = np.zeros((len(y), len(x)))
    col = np.searchsorted(x, np.round(data["node"][:, 0], 9))
    row = np.searchsorted(y, np.round(data["node"][:, 1], 9))
    field[row, col] = data["contact"][phase]
    axis.contour(x * 1e3, y * 1e3, field, levels=[0.5], colors="black", linewidths=1.2)
