"""What section V.D comes to: the grasp with a knock, and the knocks that a method stands."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from paper import figure_style
from paper.blocks import Block, Claim, Figure, Report, Table, Text, deviations, prose
from paper.chain import CMP, CMP_PAPER, Method
from paper.dot_tracking import DMP_GRID, DMP_NEAREST, FOLLOWING_METHODS
from paper.experiment import Arrays, Experiment, Results, number
from paper.experiments.grasp import COLUMNS, cases

# Of the error of a force, share of the largest true force: set before anything was measured.
LIMIT = 0.05
# The paper's stages, and before and after them, by the phases of the scene.
STAGES = {
    "before": ("rest",),
    "clamping": ("close", "drag"),
    "disturbance": ("knock", "hold", "knock back"),
    "release": ("open",),
    "after": ("rest again",),
}

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StageError:
    """Of the resultant force, shares of the peak; NaN where no frame of the stage gave a force."""

    rms: float
    largest: float


def frames_of(phase: NDArray[np.str_], stage: str) -> NDArray[np.intp]:
    """Frames of a stage."""
    return np.flatnonzero(np.isin(phase, STAGES[stage]))


@dataclass(frozen=True)
class GraspScore:
    """Of one method; S draws of the noise, F frames.

    force, moment (S, F): distance of the measured from the true resultant, as a share of the
    largest true one; NaN where the method gave none.  wrong, found (S, F): shares of the visible
    markers.  wrench (S, F, 6).  flags (S, F): what the force stage itself warns of.
    """

    phase: NDArray[np.str_]
    wrench: Array
    force: Array
    moment: Array
    wrong: Array
    found: Array
    flags: NDArray[np.int_]

    @classmethod
    def from_arrays(cls, arrays: Arrays, key: str) -> GraspScore:
        """From the result of `measure_grasp`."""
        true, wrench = arrays["true_wrench"], arrays[f"{key}.wrench"]
        return cls(
            arrays["phase"],
            wrench,
            _share(wrench[..., :3], true[:, :3]),
            _share(wrench[..., 3:], true[:, 3:]),
            arrays[f"{key}.wrong"],
            arrays[f"{key}.found"],
            arrays[f"{key}.flags"],
        )

    def error_in(self, stage: str) -> StageError:
        """Over all frames and draws of a stage."""
        error = self.force[:, frames_of(self.phase, stage)]
        error = error[np.isfinite(error)]
        if not error.size:
            return StageError(float("nan"), float("nan"))
        return StageError(float(np.sqrt(np.mean(error**2))), float(error.max()))

    @property
    def bad(self) -> NDArray[np.bool_]:
        """(F,) frames in which a draw has a wrong number, no force or one beyond LIMIT."""
        error = np.where(np.isfinite(self.force), self.force, np.inf)
        return np.asarray(((self.wrong > 0) | (error > LIMIT)).any(axis=0))

    @property
    def frames_wrong(self) -> int:
        """Frames in which a draw has wrong numbers."""
        return int((self.wrong > 0).any(axis=0).sum())

    @property
    def warned(self) -> int:
        """Bad frames in which the force stage warns, in every draw."""
        return int((self.bad & (self.flags != 0).all(axis=0)).sum())

    @property
    def first_bad(self) -> int | None:
        """The first of the bad frames."""
        return int(np.argmax(self.bad)) if self.bad.any() else None

    @property
    def good_again(self) -> int | None:
        """The frame from which on none is bad; None where none was or the last one still is."""
        if not self.bad.any() or self.bad[-1]:
            return None
        return int(np.flatnonzero(self.bad)[-1]) + 1

    @property
    def noise(self) -> Array:
        """Standard deviation of Fx, Fy, Fz (3,) N while the bar is held still."""
        held = self.wrench[:, self.phase == "hold", :3]
        return np.asarray(np.nanstd(held, axis=1).mean(axis=0))

    @property
    def at_rest(self) -> float:
        """The largest force that is measured where nothing touches, N."""
        free = np.linalg.norm(self.wrench[:, frames_of(self.phase, "before"), :3], axis=-1)
        return float(np.nanmax(free))


def _share(measured: Array, true: Array) -> Array:
    peak = np.linalg.norm(true, axis=-1).max()
    return np.asarray(np.linalg.norm(measured - true, axis=-1) / peak)


@dataclass(frozen=True)
class KnockScore:
    """Of one method over knocks of all sizes.

    jump (N,) pitches, rising.  wrong, lost, force (N,): of the knock's frame, shares of the visible
    markers with wrong numbers and of those not found, error of the force as a share of the peak;
    infinite where there was none.  approach: whether all was well before each knock.
    """

    jump: Array
    wrong: Array
    lost: Array
    force: Array
    approach: bool

    @classmethod
    def from_knocks(cls, knocks: Array) -> KnockScore:
        """From results (..., COLUMNS) of `knocks`, of one or many directions."""
        rows = knocks.reshape(-1, len(COLUMNS))
        stated = dict(zip(COLUMNS, rows[np.argsort(rows[:, 0], kind="stable")].T, strict=True))
        return cls(
            stated["jump"],
            stated["wrong"],
            1 - stated["found"],
            _known(stated["force"]),
            bool((stated["before"] == 0).all()),
        )

    @property
    def misnumbers_from(self) -> float | None:
        """The smallest jump with a wrong number, pitches; None where there is none."""
        return _smallest(self.jump, self.wrong > 0)

    @property
    def fails_from(self) -> float | None:
        """The smallest jump whose force is off by more than LIMIT; None where none is."""
        return _smallest(self.jump, self.force > LIMIT)

    @property
    def always_misnumbers_from(self) -> float | None:
        """The jump from which on all knocks bring wrong numbers; None where the largest do not."""
        right = np.flatnonzero(self.wrong == 0)
        first = 0 if not len(right) else int(right[-1]) + 1
        return float(self.jump[first]) if first < len(self.jump) else None


def largest_held(score: KnockScore) -> float | None:
    """The largest jump up to which all knocks hold, pitches; None where the smallest does not."""
    held = (score.wrong == 0) & (score.force <= LIMIT)
    count = len(held) if held.all() else int(np.argmin(held))
    return float(score.jump[count - 1]) if count else None


def _known(error: Array) -> Array:
    return np.where(np.isfinite(error), error, np.inf)


def _smallest(jump: Array, where: NDArray[np.bool_]) -> float | None:
    return float(jump[where].min()) if where.any() else None


Grasps = Mapping[Method, GraspScore]
Knocks = Mapping[Method, KnockScore]


def report(results: Results, folder: Path) -> Report:
    """Figures, tables and claims."""
    by_method = {method: results[f"grasp-{method.pattern_type}"] for method in FOLLOWING_METHODS}
    grasps = {
        method: GraspScore.from_arrays(arrays, method.key) for method, arrays in by_method.items()
    }
    knocks = _knocks(results)
    shown = {method: by_method[method] for method in (DMP_NEAREST, CMP)}
    jump = number(by_method[CMP], "jump")
    blocks: tuple[Block, ...] = (
        prose("grasp", "setup"),
        _finding(grasps),
        Figure(
            draw_forces(by_method[CMP], grasps, folder / "grasp_forces.png"),
            "As Fig. 16 (b): contact force, moment about the gel frame's origin and share of wrong "
            "numbers over time, one draw of the noise.  Hidden lines lie on the truth.",
        ),
        _stage_table(grasps),
        _frame_table(grasps),
        Figure(
            draw_tracks(shown, folder / "grasp_tracks.png"),
            f"As Fig. 16 (c): the left view in the knock's frame, in which the gel jumps by "
            f"{jump:.3g} pitches.  A thin line ends where the method says that the marker is, and "
            "begins where it was in the frame before.",
        ),
        Figure(
            draw_distributions(
                by_method[CMP], [*shown.items()], folder / "grasp_distributions.png"
            ),
            "As Fig. 16 (d), (e): the contact force in that frame; colour: pressure, arrows: "
            "tangential force.  The truth is known on a finer grid of nodes.",
        ),
        prose("grasp", "definitions"),
        Figure(
            draw_knocks(knocks, folder / "grasp_knocks.png"),
            "The frame right after a knock, by the size of the knock; a point is one knock.  On "
            "the right those are left out for which no force was given.",
        ),
        _knock_table(knocks),
    )
    x, _, z = np.abs(by_method[CMP]["true_wrench"][:, :3]).max(axis=0).tolist()
    departures = deviations("grasp", normal=z, tangential=x, jump=jump)
    return Report(blocks, _claims(grasps, knocks, jump), departures)


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
    lost = "; ".join(method.label for method, grasp in grasps.items() if grasp.bad.any())
    kept = "; ".join(method.label for method, grasp in grasps.items() if not grasp.bad.any())
    return Text(f"Recorded without a bad frame by: {kept or 'none'}. Not by: {lost or 'none'}.")


def _stage_table(grasps: Grasps) -> Table:
    rows = []
    for method, grasp in grasps.items():
        stages = [grasp.error_in(stage) for stage in STAGES]
        cells = (f"{_percent(s.rms)} / {_percent(s.largest)}" for s in stages)
        rows.append((method.label, *cells))
    return Table(
        ("method", *STAGES),
        tuple(rows),
        "Error of the resultant force, RMS / largest, % of the largest true force of the grasp.",
    )


def _frame_table(grasps: Grasps) -> Table:
    columns: dict[str, Callable[[Method, GraspScore], str]] = {
        "method": lambda method, _: method.label,
        "frames with wrong numbers": lambda _, grasp: f"{grasp.frames_wrong} of {len(grasp.phase)}",
        "most wrong numbers, % of markers": lambda _, grasp: _percent(float(grasp.wrong.max())),
        "first bad frame": lambda _, grasp: _first(grasp),
        "good again from": lambda _, grasp: _again(grasp),
        "bad frames that the force stage flags": lambda _, grasp: _warned(grasp),
        "largest moment error, % of peak": lambda _, grasp: _percent(
            float(np.nanmax(grasp.moment))
        ),
        "force at rest, mN": lambda _, grasp: f"{1e3 * grasp.at_rest:.2g}",
        "noise of Fx, Fy, Fz while held, mN": lambda _, grasp: ", ".join(
            f"{1e3 * value:.2g}" for value in grasp.noise
        ),
    }
    caption = (
        "A frame is bad where any draw of the noise has a wrong number, no force, or a force more "
        f"than {LIMIT:.0%} of the peak off.  A method that keeps wrong numbers may be good again "
        "after the second knock, as that takes the gel back to where it was: what it has lost it "
        "finds by this chance alone.  Where the force stage sees no contact it gives 0."
    )
    return Table.from_columns(columns, grasps.items(), caption)


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
    def up_to(score: KnockScore) -> str:
        return f"not up to {score.jump[-1]:.3g}"

    columns: dict[str, Callable[[Method, KnockScore], str]] = {
        "method": lambda method, _: method.label,
        "holds up to": lambda _, score: _pitches(largest_held(score), "none held"),
        "wrong numbers from": lambda _, score: _pitches(score.misnumbers_from, up_to(score)),
        "always wrong from": lambda _, score: _pitches(score.always_misnumbers_from, "-"),
        f"force off by > {LIMIT:.0%} from": lambda _, score: _pitches(
            score.fails_from, up_to(score)
        ),
        "markers lost, most": lambda _, score: _percent(float(score.lost.max())) + " %",
    }
    count = len(next(iter(knocks.values())).jump)
    caption = (
        f"Jump of the gel from one frame to the next, pitches; {count} knocks of each method.  "
        "`holds up to`: no smaller knock has a wrong number or a force beyond the limit."
    )
    return Table.from_columns(columns, knocks.items(), caption)


def _claims(grasps: Grasps, knocks: Knocks, jump: float) -> tuple[Claim, ...]:
    nearest, grid = grasps[DMP_NEAREST], grasps[DMP_GRID]
    disturbed, earlier = nearest.error_in("disturbance"), nearest.error_in("clamping")
    begins = knocks[DMP_NEAREST].misnumbers_from
    most = _percent(max(grasps[m].error_in(s).largest for m in (CMP,) for s in STAGES))
    return (
        *(_records(method, grasps[method]) for method in (CMP, CMP_PAPER)),
        Claim(
            "V.D",
            f"DMP as in II.A, grasp with a knock of {jump:.2g} pitches in a frame: force",
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


SHADES = {"clamping": "#eef3e2", "disturbance": "#f6e3dc", "release": "#e3ecf6"}
MM = 1e3
# Around the markers of the crop, px.
MARGIN = 12
ARROW_STEP = 2
# Axes reach this far from 0, N or N mm, so that noise alone does not fill them.
LEAST_SPAN = 0.1


def draw_forces(
    arrays: Arrays, scores: Mapping[Method, GraspScore], path: Path, draw: int = 0
) -> Path:
    """Force, moment and share of wrong numbers over time, of one draw of the noise."""
    figure, axes = figure_style.panels(4, 2, 8.2, sharex=True)
    time = np.arange(len(arrays["phase"])) / number(arrays, "rate")
    true = arrays["true_wrench"]
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
        _shade(axis, arrays, time)
        low, high = axis.get_ylim()
        axis.set_ylim(min(low, -LEAST_SPAN), max(high, LEAST_SPAN))
    for axis in axes[3]:
        axis.set_xlabel("time, s")
    axes[3, 1].plot([], [], color="k", linewidth=3.5, alpha=0.3, label="truth")
    _name_stages(axes[0, 0], arrays, time)
    figure_style.legend(figure, axes[3, 1], 3, "upper")
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


def _shade(axis: Axes, arrays: Arrays, time: NDArray[np.float64]) -> None:
    half = (time[1] - time[0]) / 2
    for stage, colour in SHADES.items():
        frames = frames_of(arrays["phase"], stage)
        axis.axvspan(time[frames[0]] - half, time[frames[-1]] + half, color=colour, zorder=0)
    assert set(SHADES) <= set(STAGES)  # noqa: S101


def _name_stages(axis: Axes, arrays: Arrays, time: NDArray[np.float64]) -> None:
    for stage in SHADES:
        middle = float(time[frames_of(arrays["phase"], stage)].mean())
        axis.annotate(
            stage,
            (middle, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=8,
        )


def draw_tracks(by_method: Mapping[Method, Arrays], path: Path) -> Path:
    """The left view at the knock, with true and matched tracks from the frame before."""
    figure, axes = figure_style.panels(1, len(by_method), 4.6, layout="constrained")
    for axis, (method, arrays) in zip(axes, by_method.items(), strict=True):
        axis.imshow(arrays["crop"], cmap="gray", vmin=0, vmax=330)
        _tracks(axis, arrays["true_before"], arrays["true_after"], "#009E73", "true")
        colour = figure_style.COLOURS["dmp_nearest"]
        before, after = arrays[f"{method.key}.before"], arrays[f"{method.key}.after"]
        _tracks(axis, before, after, colour, "matched")
        axis.set(title=method.label, xticks=[], yticks=[], **_limits(arrays["true_after"]))
        axis.grid(visible=False)
        axis.spines[:].set_visible(False)
    figure_style.legend(figure, axes[0], 2)
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
    fields = [("truth", *_traction(truth["true_nodes"], truth["true_node_force"]))]
    for method, arrays in measured:
        nodes, force = arrays[f"{method.key}.nodes"], arrays[f"{method.key}.node_force"]
        fields.append((method.label, *_traction(nodes, force)))
    figure, axes = figure_style.panels(1, len(fields), 3.3, sharey=True)
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
    figure, axes = figure_style.panels(1, 3, 3.4, sharex=True)
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
    figure_style.legend(figure, axes[0], 5, "upper")
    return figure_style.save(figure, path)
