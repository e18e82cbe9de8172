"""What section V.D comes to: the grasp with a knock, and the knocks that a method stands."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from paper.dot_methods import DMP_GRID, DMP_NEAREST, FOLLOWING_METHODS
from paper.experiment import (
    Arrays,
    Block,
    Claim,
    Experiment,
    Figure,
    Report,
    Results,
    Table,
    Text,
    number,
)
from paper.grasp import cases
from paper.grasp_figures import draw_distributions, draw_forces, draw_knocks, draw_tracks
from paper.grasp_scores import LIMIT, STAGES, GraspScore
from paper.grasp_texts import DEFINITIONS, DEVIATIONS, SETUP, force_and_knock
from paper.knock_scores import KnockScore, largest_held
from paper.method import CMP, CMP_PAPER, Method

__all__ = ["EXPERIMENT", "report"]

Grasps = Mapping[Method, GraspScore]
Knocks = Mapping[Method, KnockScore]


def report(results: Results, folder: Path) -> Report:
    """Figures, tables and claims."""
    films = {method: results[f"grasp-{method.pattern_type}"] for method in FOLLOWING_METHODS}
    grasps = {method: GraspScore.from_arrays(film, method.key) for method, film in films.items()}
    knocks = _knocks(results)
    shown = {method: films[method] for method in (DMP_NEAREST, CMP)}
    blocks: tuple[Block, ...] = (
        SETUP,
        _finding(grasps),
        Figure(
            draw_forces(films[CMP], grasps, folder / "grasp_forces.png"),
            "As Fig. 16 (b): contact force, moment about the gel frame's origin and share of wrong "
            "numbers over time, one draw of the noise.  Hidden lines lie on the truth.",
        ),
        _stage_table(grasps),
        _frame_table(grasps),
        Figure(
            draw_tracks(shown, folder / "grasp_tracks.png"),
            f"As Fig. 16 (c): the left view in the knock's frame, in which the gel jumps by "
            f"{number(films[CMP], 'jump'):.3g} pitches.  A thin line ends where the method says "
            "that the marker is, and begins where it was in the frame before.",
        ),
        Figure(
            draw_distributions(films[CMP], [*shown.items()], folder / "grasp_distributions.png"),
            "As Fig. 16 (d), (e): the contact force in that frame; colour: pressure, arrows: "
            "tangential force.  The truth is known on a finer grid of nodes.",
        ),
        DEFINITIONS,
        Figure(
            draw_knocks(knocks, folder / "grasp_knocks.png"),
            "The frame right after a knock, by the size of the knock; a point is one knock.  On "
            "the right those are left out for which no force was given.",
        ),
        _knock_table(knocks),
    )
    x, y, z = np.abs(films[CMP]["true_wrench"][:, :3]).max(axis=0).tolist()
    told = force_and_knock((x, y, z), number(films[CMP], "jump"))
    return Report(blocks, _claims(grasps, knocks, films), (told, *DEVIATIONS))


def _knocks(results: Results) -> Knocks:
    found = {}
    for method in FOLLOWING_METHODS:
        parts = [
            arrays[method.key].reshape(-1, arrays[method.key].shape[-1])
            for name, arrays in results.items()
            if name.startswith("knock-") and method.key in arrays
        ]
        found[method] = KnockScore.from_knocks(np.concatenate(parts))
    return found


def _finding(grasps: Grasps) -> Text:
    """Which methods lose the grasp, in words."""
    lost = [method.label for method, grasp in grasps.items() if grasp.bad.any()]
    kept = [method.label for method, grasp in grasps.items() if not grasp.bad.any()]
    told = f"Recorded without a bad frame by: {'; '.join(kept) or 'none'}.  "
    told += f"Not by: {'; '.join(lost) or 'none'}."
    dots = [m.label for m in FOLLOWING_METHODS if m.pattern_type == "dmp" and m.label in kept]
    if dots and DMP_NEAREST.label in lost:
        told += (
            "  So dots as such stand this knock: it is matching by the nearest place that fails, "
            f"as the paper finds, and a better matching mends it ({'; '.join(dots)})."
        )
    return Text(told)


def _stage_table(grasps: Grasps) -> Table:
    rows = []
    for method, grasp in grasps.items():
        stages = [grasp.of_stage(stage) for stage in STAGES]
        cells = (f"{_percent(s.rms)} / {_percent(s.largest)}" for s in stages)
        rows.append((method.label, *cells))
    return Table(
        ("method", *STAGES),
        tuple(rows),
        "Error of the resultant force, RMS / largest, % of the largest true force of the grasp.",
    )


def _frame_table(grasps: Grasps) -> Table:
    head = (
        "method",
        "frames with wrong numbers",
        "most wrong numbers, % of markers",
        "first bad frame",
        "good again from",
        "bad frames that the force stage flags",
        "largest moment error, % of peak",
        "force at rest, mN",
        "noise of Fx, Fy, Fz while held, mN",
    )
    rows = []
    for method, grasp in grasps.items():
        wrong = f"{grasp.frames_wrong} of {len(grasp.phase)}"
        noise = ", ".join(f"{1e3 * value:.2g}" for value in grasp.noise)
        most = _percent(float(grasp.wrong.max()))
        moment = _percent(float(np.nanmax(grasp.moment)))
        rest = f"{1e3 * grasp.at_rest:.2g}"
        when = _first(grasp), _again(grasp), _warned(grasp)
        rows.append((method.label, wrong, most, *when, moment, rest, noise))
    caption = (
        "A frame is bad where any draw of the noise has a wrong number, no force, or a force more "
        f"than {LIMIT:.0%} of the peak off.  A method that keeps wrong numbers may be good again "
        "after the second knock, as that takes the gel back to where it was: what it has lost it "
        "finds by this chance alone.  Where the force stage sees no contact it tells 0."
    )
    return Table(head, tuple(rows), caption)


def _first(grasp: GraspScore) -> str:
    first = grasp.first_bad
    return "none" if first is None else f"{first} ({grasp.phase[first]})"


def _again(grasp: GraspScore) -> str:
    if grasp.first_bad is None:
        return "-"
    again = grasp.good_again
    if again is None:
        return "never"
    return f"{again} ({grasp.phase[again]}), {again - grasp.first_bad} frames later"


def _warned(grasp: GraspScore) -> str:
    return "-" if grasp.first_bad is None else f"{grasp.warned} of {int(grasp.bad.sum())}"


def _knock_table(knocks: Knocks) -> Table:
    head = (
        "method",
        "holds up to",
        "wrong numbers from",
        "always wrong from",
        f"force off by > {LIMIT:.0%} from",
        "markers lost, most",
    )
    rows = []
    for method, score in knocks.items():
        largest = score.jump[-1]
        rows.append(
            (
                method.label,
                _pitches(largest_held(score), "none held"),
                _pitches(score.misnumbers_from, f"not up to {largest:.3g}"),
                _pitches(score.always_misnumbers_from, "-"),
                _pitches(score.fails_from, f"not up to {largest:.3g}"),
                _percent(float(score.lost.max())) + " %",
            )
        )
    count = len(next(iter(knocks.values())).jump)
    caption = (
        f"Jump of the gel from one frame to the next, pitches; {count} knocks of each method.  "
        "`holds up to`: no smaller knock has a wrong number or a force beyond the limit."
    )
    return Table(head, tuple(rows), caption)


def _claims(grasps: Grasps, knocks: Knocks, films: Mapping[Method, Arrays]) -> tuple[Claim, ...]:
    nearest, grid = grasps[DMP_NEAREST], grasps[DMP_GRID]
    disturbed, earlier = nearest.of_stage("disturbance"), nearest.of_stage("clamping")
    begins = knocks[DMP_NEAREST].misnumbers_from
    most = _percent(max(grasps[m].of_stage(s).largest for m in (CMP,) for s in STAGES))
    return (
        *(_records(method, grasps[method]) for method in (CMP, CMP_PAPER)),
        Claim(
            "V.D",
            f"DMP as in II.A, grasp with a knock of {number(films[CMP], 'jump'):.2g} pitches in a "
            "frame: force",
            "large deviation at the disturbance",
            f"up to {_percent(disturbed.largest)} % of the peak ({_percent(earlier.largest)} % "
            f"before it; CMP: {most} %)",
            bool(earlier.largest <= LIMIT < disturbed.largest),
        ),
        Claim(
            "V.D",
            "Matching by the nearest marker errs where markers move between frames by",
            "close to their distance (1 pitch)",
            _pitches(begins, "no jump that was tried"),
            begins is not None and begins <= 1.0,
        ),
        _severe(knocks),
        Claim(
            "II.A, V.D",
            "DMP that numbers dots by their order in the grid, same knock: wrong numbers",
            "DMP: only non-rigid matching, which may fail",
            f"{grid.frames_wrong} frames; force off by at most "
            f"{_percent(float(np.nanmax(grid.force)))} % of the peak",
            bool(grid.bad.any()),
        ),
    )


def _severe(knocks: Knocks) -> Claim:
    """CMP over all knocks, beside the DMP method that holds furthest."""
    cmp, furthest = knocks[CMP], float(knocks[CMP].jump[-1])
    held = {method: largest_held(score) or 0.0 for method, score in knocks.items()}
    dots = max((m for m in FOLLOWING_METHODS if m.pattern_type == "dmp"), key=lambda m: held[m])
    wrong = "no wrong number" if cmp.misnumbers_from is None else "wrong numbers"
    return Claim(
        "V.D",
        f"CMP, knocks of up to {furthest:.2g} pitches per frame",
        "reliable even under severe contact",
        f"holds up to {held[CMP]:.2g} pitches; {wrong}, up to "
        f"{_percent(float(cmp.lost.max()))} % of the markers lost "
        f"({dots.label}: holds up to {held[dots]:.2g})",
        held[CMP] == furthest,
    )


def _records(method: Method, grasp: GraspScore) -> Claim:
    error = np.where(np.isfinite(grasp.force), grasp.force, np.inf)
    return Claim(
        "V.D",
        f"{method.label}: contact force of the whole grasp",
        "recorded perfectly",
        f"off by at most {_percent(float(error.max()))} % of the peak, wrong numbers in "
        f"{grasp.frames_wrong} of {len(grasp.phase)} frames",
        not grasp.bad.any(),
    )


def _percent(share: float) -> str:
    if not np.isfinite(share):
        return "no force"
    return "0" if share == 0 else f"{100 * share:.3g}"


def _pitches(jump: float | None, otherwise: str) -> str:
    return otherwise if jump is None else f"{jump:.2g} pitches"


EXPERIMENT = Experiment(
    key="grasp",
    section="V.D",
    title="Grasp of a hexagonal wrench with a knock",
    cases=cases,
    report=report,
)
