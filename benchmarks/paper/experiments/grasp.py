"""V.D: the grasp of a hexagonal wrench with a knock, and knocks of any size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Hold, MoveBy, Phase, Scene
from cmp_tactile_simulation.scenes.file import load_scene
from paper.chain import CMP, CMP_PAPER, Chain, Method, score_markers
from paper.dot_trackers import DMP_GRID, DMP_NEAREST, FOLLOWING_METHODS
from paper.lab import Arrays, Lab, Mechanics, Workplace, mechanics_of
from paper.page import PAPER_COLOUR, TRUE_COLOUR, Page, figures, legend, look, panels
from paper.sequence import PrintedGel, Truth

TITLE = "V.D: Grasp of a hexagonal wrench with a knock"
# The quick run's phases last so many frames where the scene's last longer.
FAST_FRAMES = {"rest": 2, "close": 6, "hold": 3, "open": 6, "rest again": 2}
FAST_NODES = 28
# Of the bar from the middle to either end of the stroke, m: the gel under it moves 1.5 pitches.
HALF_STROKE = 0.00115
PRESS = 0.0011
STROKE_FRAMES = 60
# In which the bar moves, (x, y) of length 1 in the gel frame.
DIRECTIONS = {"along": (1.0, 0.0), "across": (0.0, 1.0), "diagonal": (0.5**0.5, 0.5**0.5)}
# Jumps of the gel, pitches from one frame to the next.
SIZES = (0.2, 0.4, 0.45, 0.5, 0.55, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0)
FAST_SIZES = (0.4, 0.8, 2.0)
# Markers move by so many pitches from frame to frame on the way to where a knock begins.
SLOW = 0.2
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
REFERENCE_IMAGES = 4
# Noise of the frames of the reference, so that no measured frame is its own reference.
REFERENCE_NUMBER, NUMBERS_OF_A_DRAW = 10_000, 100_000

Array = NDArray[np.float64]


def run(lab: Lab, page: Page) -> None:
    """The grasp and the knocks, each once for a print; the quick run has one direction."""
    prints, seeds = ("cmp", "dmp"), 1 if lab.fast else 3
    grasp = dict(zip(prints, lab.compute(measure_grasp, [(p, seeds) for p in prints]), strict=True))
    directions = ["along"] if lab.fast else list(DIRECTIONS)
    sizes = FAST_SIZES if lab.fast else SIZES
    cases = [(kind, direction, sizes) for kind in prints for direction in directions]
    knocked = lab.compute(knocks, cases)
    grasps = {m: GraspScore.from_arrays(grasp[m.pattern_type], m.key) for m in FOLLOWING_METHODS}
    scores = {
        m: KnockScore.from_knocks([part[m.key] for part in knocked if m.key in part])
        for m in FOLLOWING_METHODS
    }
    jump, (x, _, z) = float(grasp["cmp"]["jump"]), np.abs(grasp["cmp"]["wrench"]).max(axis=0)[:3]
    page.prose("grasp", "setup")
    page.figure(_draw_forces(grasp["cmp"], grasps), "grasp.forces")
    _grasp_table(grasps, page)
    page.prose("grasp", "definitions")
    page.figure(_draw_knocks(scores), "grasp.knocks")
    _knock_table(scores, page)
    claims(grasps, scores, jump, page)
    page.departures("grasp", normal=z, tangential=x, jump=jump)


def sensor() -> SensorDescription:
    """That of the paper's section V.  Its gel is that of the scene's sensor."""
    return load_sensor("prototype")


def grasp_scene(place: Workplace) -> Scene:
    """The packaged scene on the prototype; the quick run has fewer frames of what is slow."""
    scene = replace(load_scene("grasp"), sensor=sensor())
    if not place.fast:
        return scene
    motion = tuple(
        replace(phase, frames=min(phase.frames, FAST_FRAMES.get(phase.name, phase.frames)))
        for phase in scene.motion
    )
    return replace(scene, motion=motion, contact_nodes=FAST_NODES)


def stroke_scene(place: Workplace, direction: str) -> Scene:
    """The same bar, pressed in and pushed slowly from one side to the other."""
    x, y = (HALF_STROKE * part for part in DIRECTIONS[direction])
    motion = (
        Phase("rest", 1, Hold()),
        Phase("close", 7, MoveBy((0.0, 0.0, -PRESS))),
        Phase("drag", 5, MoveBy((-x, -y, 0.0))),
        Phase("stroke", STROKE_FRAMES, MoveBy((2 * x, 2 * y, 0.0)), "linear"),
    )
    return replace(grasp_scene(place), name=f"stroke_{direction}", motion=motion)


@dataclass(frozen=True)
class StrokePath:
    """Frames of a stroke by how far the gel has gone.

    close: frames that press the bar in, before it is anywhere aside.  frames: of the stroke.
    travel: pitches that the marker which moves furthest has gone in each of these from the
    stroke's middle, negative before it.
    """

    close: tuple[int, ...]
    frames: NDArray[np.intp]
    travel: Array

    @classmethod
    def from_mechanics(cls, mechanics: Mechanics, pitch: float) -> StrokePath:
        """Of a scene with the phases close and stroke."""
        frames = mechanics.frames("stroke")
        moved = mechanics.displacement[frames] - mechanics.displacement[frames[0]]
        travel = np.linalg.norm(moved, axis=-1).max(axis=(1, 2)) / pitch
        close = tuple(mechanics.frames("rest", "close").tolist())[::2]
        return cls(close, frames, travel - travel[-1] / 2)

    def to_start(self, start: float) -> list[int]:
        """Frames from the gel at rest to where the bar has gone `start` pitches aside."""
        steps = max(int(np.ceil(abs(start) / SLOW)), 1)
        return [*self.close, *(self.nearest(start * k / steps) for k in range(steps + 1))]

    def nearest(self, travel: float) -> int:
        """The frame in which the gel has gone so many pitches."""
        return int(self.frames[np.argmin(np.abs(self.travel - travel))])


@dataclass(frozen=True)
class _Shot:
    image: NDArray[np.uint8]
    truth: Truth
    force: Array


class _Stroke:
    """A slow stroke; each frame is rendered at its first use."""

    def __init__(self, place: Workplace, direction: str, pattern_type: str) -> None:
        scene = stroke_scene(place, direction)
        self.sensor = scene.sensor
        self._mechanics = mechanics_of(scene, place)
        self._gel = PrintedGel(scene.sensor, pattern_type)
        self.path = StrokePath.from_mechanics(self._mechanics, scene.sensor.pattern.pitch)
        self._shots: dict[int, _Shot] = {}

    @cached_property
    def peak(self) -> float:
        """The largest force of the stroke, N."""
        return float(np.linalg.norm(self._mechanics.wrench[:, :3], axis=1).max())

    def at_rest(self) -> list[NDArray[np.uint8]]:
        """Images for the reference."""
        rendered = self._gel.rendered(self._surface(0))
        return [self._gel.exposed(rendered, REFERENCE_NUMBER + k) for k in range(REFERENCE_IMAGES)]

    def shot(self, frame: int) -> _Shot:
        """A frame with its truth."""
        if frame not in self._shots:
            surface = self._surface(frame)
            image, truth = self._gel.image(surface, frame), self._gel.truth(surface)
            self._shots[frame] = _Shot(image, truth, self._mechanics.wrench[frame, :3])
        return self._shots[frame]

    def _surface(self, frame: int) -> DeformedSurface:
        return self._mechanics.surface(frame, self.sensor.pattern)


def knocks(
    place: Workplace, pattern_type: str, direction: str, sizes: tuple[float, ...]
) -> dict[str, Array]:
    """Each size (pitches) forwards and backwards: KEY (knocks, 4) of each method.

    Its columns are jump: largest true step of a marker, pitches; wrong and found, shares of the
    visible markers in the knock's frame; force: its error, share of the stroke's largest force.
    """
    stroke, result = _Stroke(place, direction, pattern_type), {}
    for method in FOLLOWING_METHODS:
        if method.pattern_type == pattern_type:
            chain = Chain(stroke.sensor, method, with_force=True)
            chain.set_reference(stroke.at_rest())
            rows = [_knocked(chain, stroke, sign * size) for size in sizes for sign in (1, -1)]
            result[method.key] = np.array(rows)
    return result


def _knocked(chain: Chain, stroke: _Stroke, size: float) -> list[float]:
    """A row of `knocks`: slowly to where it begins, then across the middle."""
    chain.reset()
    approach = stroke.path.to_start(-size / 2)
    for frame in approach:
        chain.measure(stroke.shot(frame).image)
    before, after = stroke.shot(approach[-1]), stroke.shot(stroke.path.nearest(size / 2))
    measured = chain.measure(after.image)
    score = score_markers(measured.grids, after.truth.grids)
    error = float("nan")
    if measured.force is not None:
        error = float(np.linalg.norm(measured.force.wrench[:3] - after.force)) / stroke.peak
    jump = largest_step(before.truth, after.truth) / stroke.sensor.pattern.pitch
    return [jump, score.wrong / score.visible, score.found_visible / score.visible, error]


def largest_step(before: Truth, after: Truth) -> float:
    """How far the marker that moves furthest moves, m."""
    step = after.surface.position - before.surface.position
    return float(np.linalg.norm(step, axis=-1).max())


def measure_grasp(place: Workplace, pattern_type: str, seeds: int) -> dict[str, Any]:
    """What all methods of a print (cmp or dmp) measure, over so many draws of the noise.

    F frames, S seeds.  phase; rate, frames/s; wrench (F, 6), the true one, N and N m; jump at the
    knock, pitches.  Of each method KEY_wrench (S, F, 6), NaN where it gives none; KEY_wrong (S, F):
    share of the visible markers.
    """
    scene = grasp_scene(place)
    mechanics = mechanics_of(scene, place)
    gel = PrintedGel(scene.sensor, pattern_type)
    surfaces = [mechanics.surface(f, scene.sensor.pattern) for f in range(len(mechanics))]
    truth, rendered = [gel.truth(s) for s in surfaces], [gel.rendered(s) for s in surfaces]
    knock, at_rest = int(mechanics.frames("knock")[0]), mechanics.frames("rest").tolist()
    result: dict[str, Any] = {
        "phase": mechanics.phase,
        "rate": mechanics.rate,
        "wrench": mechanics.wrench,
        "jump": largest_step(truth[knock - 1], truth[knock]) / scene.sensor.pattern.pitch,
    }
    for method in FOLLOWING_METHODS:
        if method.pattern_type != pattern_type:
            continue
        chain, draws = Chain(scene.sensor, method, with_force=True), []
        for first in range(0, seeds * NUMBERS_OF_A_DRAW, NUMBERS_OF_A_DRAW):
            chain.reset()
            chain.set_reference(
                [gel.exposed(rendered[f], first + f + REFERENCE_NUMBER) for f in at_rest]
            )
            chain.reset()
            images = (gel.exposed(frame, first + f) for f, frame in enumerate(rendered))
            draws.append([_numbers(chain, *pair) for pair in zip(images, truth, strict=True)])
        for n, name in enumerate(("wrench", "wrong")):
            result[f"{method.key}_{name}"] = np.array([[row[n] for row in draw] for draw in draws])
    return result


def _numbers(chain: Chain, image: NDArray[np.uint8], truth: Truth) -> tuple[Array, float]:
    measured = chain.measure(image)
    score = score_markers(measured.grids, truth.grids)
    assert measured.force is not None  # noqa: S101 - the chain was made with force
    return measured.force.wrench, score.wrong / score.visible


@dataclass(frozen=True)
class GraspScore:
    """Of one method; S draws of the noise, F frames.

    force (S, F): distance of the measured from the true resultant, as a share of the largest true
    one; NaN where the method gave none.  wrong (S, F): share of the visible markers.
    wrench (S, F, 6).
    """

    phase: NDArray[np.str_]
    wrench: Array
    force: Array
    wrong: Array

    @classmethod
    def from_arrays(cls, arrays: Arrays, key: str) -> GraspScore:
        """From the result of `measure_grasp`."""
        true, wrench = arrays["wrench"][:, :3], arrays[f"{key}_wrench"]
        off = np.linalg.norm(wrench[..., :3] - true, axis=-1)
        force = off / np.linalg.norm(true, axis=-1).max()
        return cls(arrays["phase"], wrench, force, arrays[f"{key}_wrong"])

    def largest_in(self, stage: str) -> float:
        """Largest error of the force in a stage; NaN where no frame of it gave a force."""
        error = self.force[:, frames_of(self.phase, stage)]
        return float(np.nanmax(error)) if np.isfinite(error).any() else float("nan")

    @property
    def bad(self) -> NDArray[np.bool_]:
        """(F,) frames in which a draw has a wrong number, no force or one beyond LIMIT."""
        error = np.where(np.isfinite(self.force), self.force, np.inf)
        return np.asarray(((self.wrong > 0) | (error > LIMIT)).any(axis=0))

    @property
    def frames_wrong(self) -> int:
        """Frames in which a draw has wrong numbers."""
        return int((self.wrong > 0).any(axis=0).sum())


def frames_of(phase: NDArray[np.str_], stage: str) -> NDArray[np.intp]:
    """Frames of a stage."""
    return np.flatnonzero(np.isin(phase, STAGES[stage]))


@dataclass(frozen=True)
class KnockScore:
    """Of one method over knocks of all sizes.

    jump (N,) pitches, rising.  wrong, lost, force (N,): of the knock's frame, shares of the visible
    markers with wrong numbers and of those not found, error of the force as a share of the peak;
    infinite where there was none.
    """

    jump: Array
    wrong: Array
    lost: Array
    force: Array

    @classmethod
    def from_knocks(cls, parts: Sequence[Array]) -> KnockScore:
        """From results of `knocks`, of one or many directions."""
        rows = np.concatenate(parts)
        jump, wrong, found, force = rows[np.argsort(rows[:, 0], kind="stable")].T
        return cls(jump, wrong, 1 - found, np.where(np.isfinite(force), force, np.inf))

    @property
    def misnumbers_from(self) -> float | None:
        """The smallest jump with a wrong number, pitches; None where there is none."""
        return _smallest(self.jump, self.wrong > 0)

    @property
    def fails_from(self) -> float | None:
        """The smallest jump with an error of the force above LIMIT; None if there is none."""
        return _smallest(self.jump, self.force > LIMIT)

    @property
    def holds_up_to(self) -> float | None:
        """The largest jump up to which all knocks hold; None where the smallest does not."""
        held = (self.wrong == 0) & (self.force <= LIMIT)
        count = len(held) if held.all() else int(np.argmin(held))
        return float(self.jump[count - 1]) if count else None


def _smallest(jump: Array, where: NDArray[np.bool_]) -> float | None:
    return float(jump[where].min()) if where.any() else None


def _grasp_table(grasps: Mapping[Method, GraspScore], page: Page) -> None:
    rows = []
    for method, grasp in grasps.items():
        stages = figures("{:.3g}", *(100 * grasp.largest_in(stage) for stage in STAGES))
        wrong = f"{grasp.frames_wrong} of {len(grasp.phase)}"
        rows.append((method.label, *stages, wrong, f"{grasp.bad.sum()}"))
    page.table("grasp.stages", rows, stages=[f"{stage}, %" for stage in STAGES], limit=LIMIT)


def _knock_table(knocks: Mapping[Method, KnockScore], page: Page) -> None:
    rows = []
    for method, score in knocks.items():
        jumps = score.holds_up_to, score.misnumbers_from, score.fails_from
        cells = (_pitches(jump, "none") for jump in jumps)
        rows.append((method.label, *cells, f"{100 * score.lost.max():.3g} %"))
    page.table("grasp.knocks", rows, limit=LIMIT)


def claims(
    grasps: Mapping[Method, GraspScore],
    knocks: Mapping[Method, KnockScore],
    jump: float,
    page: Page,
) -> None:
    """Compare the paper's claims on grasp and knocks with ours; jump: of the grasp, pitches."""
    most = {method: 100 * float(np.nanmax(grasp.force)) for method, grasp in grasps.items()}
    for method in (CMP, CMP_PAPER):
        grasp = grasps[method]
        page.claim(
            "grasp.recorded", not grasp.bad.any(), method=method.label, most=most[method],
            wrong=grasp.frames_wrong, frames=len(grasp.phase),
        )  # fmt: skip
    nearest, grid = grasps[DMP_NEAREST], grasps[DMP_GRID]
    stages = [nearest.largest_in(stage) for stage in ("clamping", "disturbance")]
    disturbed = nearest.force[:, frames_of(nearest.phase, "disturbance")]
    none = np.asarray(np.isnan(disturbed).any(axis=0))
    page.claim(
        "grasp.deviates", stages[0] <= LIMIT and (stages[1] > LIMIT or none.any()), jump=jump,
        percent=[100 * s for s in stages], none=none.sum(), frames=len(none), cmp=most[CMP],
    )  # fmt: skip
    begins = knocks[DMP_NEAREST].misnumbers_from
    errs = begins is not None and begins <= 1.0
    page.claim("grasp.matching", errs, begins=_pitches(begins, "no jump that was tried"))
    cmp, held = knocks[CMP], {method: score.holds_up_to or 0.0 for method, score in knocks.items()}
    dots = max((m for m in knocks if m.pattern_type == "dmp"), key=lambda m: held[m])
    page.claim(
        "grasp.knocks", held[CMP] == cmp.jump[-1], largest=cmp.jump[-1], cmp=held[CMP],
        lost=100 * cmp.lost.max(), method=dots.label, dots=held[dots],
    )  # fmt: skip
    page.claim("grasp.ordered", grid.bad.any(), wrong=grid.frames_wrong, most=most[DMP_GRID])


def _pitches(jump: float | None, otherwise: str) -> str:
    return otherwise if jump is None else f"{jump:.2g} pitches"


def _draw_forces(arrays: Arrays, grasps: Mapping[Method, GraspScore]) -> Figure:
    """Force and share of wrong numbers over time, of the first draw of the noise."""
    figure, axes = panels(2, 2, 5.4, sharex=True)
    time = np.arange(len(arrays["phase"])) / arrays["rate"]
    true: dict[str, Any] = {"color": TRUE_COLOUR, "linewidth": 3.5, "alpha": 0.3}
    names = ("Fx (along the bar), N", "Fy, N", "Fz, N")
    for k, (axis, name) in enumerate(zip(axes.flat, names, strict=False)):
        axis.plot(time, arrays["wrench"][:, k], label="truth", **true)
        axis.set_ylabel(name)
        for method, grasp in grasps.items():
            style = {**look(method.key), "marker": None}
            axis.plot(time, grasp.wrench[0, :, k], label=method.label, **style)
            axes[1, 1].plot(time, 100 * grasp.wrong[0], **style)
    disturbed = time[frames_of(arrays["phase"], "disturbance")]
    for axis in axes.flat:
        axis.axvspan(disturbed[0], disturbed[-1], color="#f6e3dc", zorder=0)
    axes[1, 1].set_ylabel("wrong numbers, %")
    figure.supxlabel("time, s")
    legend(figure, axes[0, 0], 3, "upper")
    return figure


def _draw_knocks(scores: Mapping[Method, KnockScore]) -> Figure:
    """Wrong numbers, lost markers and error of the force over the size of the knock."""
    figure, axes = panels(1, 3, 3.4, sharex=True)
    labels = ("wrong numbers, %", "markers not found, %", "error of the force, % of the peak")
    for place, (method, score) in enumerate(scores.items()):
        # Those drawn first show around those that lie on them.
        style = {
            **look(method.key, hollow=True),
            "linestyle": "none",
            "markersize": 9 - 1.5 * place,
        }
        values = score.wrong, score.lost, np.where(np.isfinite(score.force), score.force, np.nan)
        for axis, value in zip(axes, values, strict=True):
            axis.plot(score.jump, 100 * value, label=method.label, **style)
    for axis, label in zip(axes, labels, strict=True):
        axis.set(xlabel="jump of the gel in one frame, pitches", ylabel=label)
    axes[2].axhline(100 * LIMIT, color=PAPER_COLOUR, linewidth=0.8)
    legend(figure, axes[0], 5, "upper")
    return figure
