"""IV.D: tables, error maps as Fig. 11, why the methods differ, claims."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from paper.dot_methods import DMP_GRID, DMP_NEAREST
from paper.experiment import (
    Arrays,
    Block,
    Claim,
    Deviation,
    Experiment,
    Figure,
    Report,
    Results,
    Table,
    Text,
)
from paper.film import DOT_DIAMETER
from paper.marker_errors import root_mean_square
from paper.method import CMP, Method
from paper.precision import CENTRES, DMP_PLAIN, DOT_SIZES, METHODS, SHARPER, cases
from paper.precision_figures import AXES, Summary, split_of, summary_of
from paper.precision_pictures import error_maps, error_sources

__all__ = ["EXPERIMENT", "claims", "report"]

# "Noticeably larger" and "significant concentration" of the paper, as we take them.
NOTICEABLE, CONCENTRATED = 1.1, 1.5
OBJECTS = {
    "contact_sphere": "sphere of 5 mm radius",
    "contact_ring": "ring, tube of 1 mm radius",
    "contact_cube_edge": "cube's edge, 0.5 mm radius",
    "contact_hexagonal_bar": "hexagonal bar's edge, 0.4 mm radius",
}


def report(results: Results, folder: Path) -> Report:
    """What the loads tell, and what the questions about them do."""
    told: Arrays = {**results["loads_cmp"], **results["loads_dmp"]}
    phases = [str(name) for name in told["phase"]]
    last = len(phases) - 1
    summaries = {method.key: summary_of(told, method, last) for method in METHODS}
    blocks: list[Block] = [
        Text(_set_up(told)),
        _main_table(summaries, len(told["cmp_errors"])),
        Figure(
            error_maps(told, last, folder / "precision_maps.png"),
            "As the paper's Fig. 11 (d, e): displacement error of every marker under all loads, in "
            "one draw of noise, and the mean of all draws, in which noise fades. Black: the true "
            "outline of the contact. A column has one scale.",
        ),
        Text(_outcome(summaries)),
        _phase_table(told, phases),
        _sources_table(told, results),
        Text(_why(told, results)),
        Figure(
            error_sources(results, folder / "precision_sources.png"),
            "Errors by what they may come from (open: the systematic part). Left: by the object's "
            "curvature. Then, in the full run: by noise, and by dot size.",
        ),
        *_dots_table(results),
    ]
    return Report(tuple(blocks), claims(summaries), tuple(_deviations(phases)))


def _set_up(told: Arrays) -> str:
    depth = -float(np.min(told["true"][-1][..., 2])) * 1e3
    share = float(np.mean(told["inside"][-1]))
    force, torque = told["wrench"][-1][:3], told["wrench"][-1][5]
    return (
        f"A sphere of 15 mm radius on a neo-Hookean gel under {-force[2]:.3g} N, {force[0]:.3g} N "
        f"and {torque * 1e3:.3g} N mm; the deepest marker moves by {depth:.3g} mm, and {share:.0%} "
        "of the markers are in contact. Checkers and dots are printed on the same deformation, "
        "18 x 18 of each; all methods share triangulation and camera noise of 1 grey level. "
        "Errors are of displacements from the mean of four frames at rest."
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


def _outcome(summaries: dict[str, Summary]) -> str:
    ours = summaries[CMP.key]
    as_good = [
        f"{method.label} in {', '.join(axes)}"
        for method in METHODS
        if method is not CMP
        and (axes := _axes_where(summaries[method.key].rms <= ours.rms * 1.005))
    ]
    text = "By RMS error CMP is ahead of every other method along every axis."
    if as_good:
        text = f"By RMS error others do as well as CMP or better: {'; '.join(as_good)}."
    return (
        f"{text} In the table of claims, noticeably is {NOTICEABLE - 1:.0%} or more, and a "
        f"concentration is significant from {CONCENTRATED:g} times on (geometric mean of x, y, z)."
    )


PHASE_WORDS = {
    "press": "normal force alone",
    "drag": "with the tangential force",
    "turn": "with tangential force and torque",
}


def _phase_table(told: Arrays, phases: list[str]) -> Table:
    rows = []
    for index, phase in enumerate(phases):
        for method in METHODS:
            found = summary_of(told, method, index)
            rows.append(
                (
                    PHASE_WORDS[phase],
                    method.label,
                    *(_um(value) for value in found.rms),
                    *(_um(value) for value in found.largest),
                    _times(found.concentration),
                )
            )
    head = "load", "method", *(f"RMS {a}" for a in AXES), *(f"max {a}" for a in AXES)
    return Table(
        (*head, "in contact / outside: x, y, z"),
        tuple(rows),
        "The same when each load was reached, um.",
    )


def _sources_table(told: Arrays, results: Results) -> Table:
    rows = []
    contacts = [("sphere of 15 mm radius, all loads", told, len(told["phase"]) - 1)]
    contacts += [(OBJECTS[name], results[name], 0) for name in SHARPER if name in results]
    if "moved" in results:
        contacts.append(("none: the gel is shifted as a whole", results["moved"], 0))
    for name, arrays, phase in contacts:
        for method in METHODS:
            errors = arrays[f"{method.key}_errors"][:, phase]
            split = split_of(errors)
            visible, found, wrong = arrays[f"{method.key}_counts"][:, phase].sum(axis=0).tolist()
            rows.append(
                (
                    name,
                    method.label,
                    _um(split.systematic),
                    _um(split.random),
                    _um(float(np.linalg.norm(root_mean_square(errors)))),
                    f"{found / visible:.1%} / {wrong}",
                )
            )
    return Table(
        ("contact", "method", "systematic", "noise", "both", "found / wrong"),
        tuple(rows),
        "What errors consist of, RMS in space, um: what all draws of noise share, and their "
        "spread. The sharper objects are not the paper's; they are pressed 0.6 to 0.8 mm into a "
        "soft gel.",
    )


def _why(told: Arrays, results: Results) -> str:
    last = len(told["phase"]) - 1
    parts = [
        _noise_and_distortion(told, results, last),
        _sharpest(results),
        _by_dot_size(told, results, last),
        _uniformity(told, last),
    ]
    return " ".join(part for part in parts if part)


def _noise_and_distortion(told: Arrays, results: Results, last: int) -> str:
    of_all = {key: _systematic(told, key, last) for key in (CMP.key, DMP_NEAREST.key)}
    random = [split_of(told[f"{m.key}_errors"][:, last]).random for m in (CMP, DMP_NEAREST)]
    ours, dots = of_all[CMP.key], of_all[DMP_NEAREST.key]
    text = (
        f"Under the sphere of 15 mm noise adds {_um(random[0])} um to CMP and {_um(random[1])} um "
        f"to dots; the systematic error is {_um(ours)} um for CMP "
        f"and {_um(dots)} um for dots."
    )
    if "moved" not in results:
        return text
    still = [_systematic(results["moved"], key, 0) for key in of_all]
    return (
        f"{text} On a gel that is only shifted, so that nothing is distorted, it is "
        f"{_um(still[0])} um and {_um(still[1])} um: what pixels do. If what distortion does is "
        f"independent of that, it adds {_um(_rest(ours, still[0]))} um and "
        f"{_um(_rest(dots, still[1]))} um."
    )


def _sharpest(results: Results) -> str:
    names = [name for name in SHARPER if name in results]
    if not names:
        return ""
    corners, centres, plain = (
        _um(_systematic(results[names[-1]], method.key, 0))
        for method in (CMP, DMP_NEAREST, DMP_PLAIN)
    )
    return (
        "A dot is seen as a whole, and the centre of its area leaves its middle where the "
        f"surface bends: under the {OBJECTS[names[-1]]}, the systematic error of plain centroids "
        f"is {plain} um, with the neighbours' correction {centres} um, that of corners {corners} "
        "um."
    )


def _by_dot_size(told: Arrays, results: Results, last: int) -> str:
    if "dots" not in results:
        return ""
    corners = np.linalg.norm(root_mean_square(told[f"{CMP.key}_errors"][:, last]))
    errors = (results["dots"][f"{size:g}_plain_errors"][:, 0] for size in DOT_SIZES)
    ratios = np.array([np.linalg.norm(root_mean_square(each)) / corners for each in errors])
    sides = "on either side of" if ratios.min() < 1 < ratios.max() else "all on one side of"
    return (
        f"With plain centroids, dots {_sizes()} of the pitch wide err {_times(ratios)} times as "
        f"much as CMP under all loads, {sides} 1."
    )


def _uniformity(told: Arrays, last: int) -> str:
    first, final = (summary_of(told, CMP, index) for index in (0, last))
    text = (
        f"CMP's own errors in x, y, z are {_times(final.concentration)} times as large in contact "
        "as outside under all loads"
    )
    if not last:
        return f"{text}."
    return f"{text}, and {_times(first.concentration)} times under the normal force alone."


def _systematic(told: Arrays, key: str, phase: int) -> float:
    return split_of(told[f"{key}_errors"][:, phase]).systematic


def _rest(whole: float, part: float) -> float:
    """What is to be added to a part, as independent errors are."""
    return float(np.sqrt(max(whole**2 - part**2, 0.0)))


def _dots_table(results: Results) -> Iterable[Block]:
    if "dots" not in results:
        return
    told, rows = results["dots"], []
    for size, centres in product(DOT_SIZES, CENTRES):
        errors = told[f"{size:g}_{centres}_errors"][:, 0]
        split, both = split_of(errors), float(np.linalg.norm(root_mean_square(errors)))
        visible, found, wrong = told[f"{size:g}_{centres}_counts"][:, 0].sum(axis=0).tolist()
        parts = (_um(value) for value in (split.systematic, split.random, both))
        rows.append((f"{size:g}", centres, *parts, f"{found / visible:.1%} / {wrong}"))
    yield Table(
        ("dot diameter / pitch", "centres", "systematic", "noise", "both", "found / wrong"),
        tuple(rows),
        f"{DMP_GRID.label} by dot size under all loads, RMS in space, um. All other results have "
        f"{DOT_DIAMETER:g}, which was not chosen on this contact.",
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


def _deviations(phases: list[str]) -> Iterable[Deviation]:
    yield Deviation(
        "gel",
        "not told",
        "2 MPa, neo-Hookean, a cap of 27 mm radius, 6 mm thick",
        "a gel of 0.5 MPa, as elsewhere here, would be crushed by 50 N",
    )
    yield Deviation(
        "dots",
        "size and centre of a dot are not told",
        f"diameter {DOT_DIAMETER:g} of the pitch; where perspective and bending shift a dot's "
        "centre, that is corrected as far as neighbouring dots show it",
        "dots are to be tuned as carefully as checkers; plain centroids, of which only the "
        "perspective at rest is corrected, have a row of their own",
    )
    if "drag" not in phases:
        yield Deviation(
            "quick run",
            "loads held together",
            "reached in two steps on fewer contact nodes, few draws of noise, one sharper object",
            "time; the full run has every load apart",
        )


def _axes_where(mask: NDArray[np.bool_]) -> list[str]:
    return [axis for axis, holds in zip(AXES, mask, strict=True) if holds]


def _sizes() -> str:
    return ", ".join(f"{size:g}" for size in DOT_SIZES)


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
