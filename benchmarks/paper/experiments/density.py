"""Table I: how many markers a square centimetre holds, and how many of them are really measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import Grid, Status, Surface
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_simulation.hard_frames.grid_score import GridScore, join_scores, score_grid
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import load_scene
from paper.blocks import Claim, Figure, Report, Table, deviations, prose
from paper.chain import CMP, CMP_PAPER, Chain, Method
from paper.experiment import Arrays, Case, Experiment, Results, Workplace, number
from paper.figure_style import COLOURS, PAPER_COLOUR, apply, save
from paper.gel import mechanics_of
from paper.sequence import RenderedSequence

METHODS = (CMP, CMP_PAPER)
STATES = ("rest", "press")
SCENE = "ball:20mm"


def cases(place: Workplace) -> Sequence[Case]:
    """One: the prototype at rest and under a ball."""
    draws = 2 if place.fast else 10
    return [Case("prototype", count_markers, (SCENE, draws), 8.0 if place.fast else 40.0)]


def printed_area(pattern: Pattern) -> float:
    """Of all checkers that the corners belong to, laid flat, m^2."""
    return (pattern.rows + 1) * (pattern.cols + 1) * pattern.pitch**2


def virtual_count(pattern: Pattern) -> int:
    """Virtual markers of a view."""
    shape = pattern.shape
    return int(np.prod(shape.row_lines) + np.prod(shape.col_lines))


def count_markers(place: Workplace, name: str, draws: int) -> Mapping[str, NDArray[Any] | float]:
    """Markers that are measured, by method and state.

    KEY_STATE_corners, KEY_STATE_virtual (draws, 2): share measured in the two views.
    KEY_STATE_space (draws,): share of the virtual markers that are measured in 3-D.
    KEY_STATE_error, KEY_STATE_corner_error (n,): distances of measured virtual markers across their
    true gridlines and of corners from theirs, px.  corners, virtual: in all.  area, m^2.
    pitch_px: between corners, at rest.  depth, m, and normal_force, N: of the press.
    """
    scene = _scene(name, fast=place.fast)
    pattern = scene.sensor.pattern
    mechanics = mechanics_of(scene, place)
    pressed = int(mechanics.frames("hold")[-1])
    surfaces = [DeformedSurface.rest(pattern), mechanics.surface(pressed, pattern)]
    sequence = RenderedSequence(scene.sensor, surfaces, "cmp")
    found: dict[str, NDArray[Any] | float] = {
        "corners": float(np.prod(pattern.shape.corners)),
        "virtual": float(virtual_count(pattern)),
        "area": printed_area(pattern),
        "pitch_px": _pitch_px(sequence.truth(0).grids),
        "depth": -float(mechanics.displacement[pressed, ..., 2].min()),
        "normal_force": -float(mechanics.wrench[pressed, 2]),
    }
    for method in METHODS:
        found |= _counted(scene, sequence, method, draws)
    return found


def _scene(name: str, *, fast: bool) -> Scene:
    scene = load_scene(name)
    few = {"rest": 1, "press": 2 if fast else 6, "hold": 1}
    phases = (phase for phase in scene.motion if phase.name in few)
    motion = tuple(replace(phase, frames=few[phase.name]) for phase in phases)
    return replace(scene, motion=motion, contact_nodes=24 if fast else scene.contact_nodes)


def _counted(
    scene: Scene, sequence: RenderedSequence, method: Method, draws: int
) -> dict[str, NDArray[np.float64]]:
    chain = Chain(scene.sensor, method)
    data: dict[str, list[Any]] = {}
    scores: dict[str, list[GridScore]] = {state: [] for state in STATES}
    for draw in range(draws):
        exposure = sequence.exposed(draw)
        chain.reset()
        chain.set_reference(exposure.rest)
        for index, state in enumerate(STATES):
            measurement = chain.measure(exposure.frames[index])
            truth = sequence.truth(index).grids
            key = f"{method.key}_{state}"
            grids = measurement.grids.values()
            data.setdefault(f"{key}_corners", []).append([_corner_share(grid) for grid in grids])
            data.setdefault(f"{key}_virtual", []).append([_virtual_share(grid) for grid in grids])
            data.setdefault(f"{key}_space", []).append(_space_share(measurement.surface))
            scores[state] += [_score(grid, truth[name]) for name, grid in measurement.grids.items()]
    for state in STATES:
        score = join_scores(scores[state])
        data[f"{method.key}_{state}_error"] = list(score.measured)
        data[f"{method.key}_{state}_corner_error"] = list(score.corner)
    return {name: np.asarray(values, np.float64) for name, values in data.items()}


def _score(grid: Grid, truth: Grid) -> GridScore:
    visible = np.isfinite(truth.corners[..., 0])
    return score_grid(grid, truth, visible, visible)


def _corner_share(grid: Grid) -> float:
    return float(np.mean(grid.corner_status == Status.MEASURED))


def _virtual_share(grid: Grid) -> float:
    status = np.concatenate([grid.row_line_status.ravel(), grid.col_line_status.ravel()])
    return float(np.mean(status == Status.MEASURED))


def _space_share(surface: Surface) -> float:
    status = np.concatenate([surface.row_status.ravel(), surface.col_status.ravel()])
    return float(np.mean(status == Status.MEASURED))


def _pitch_px(grids: Mapping[str, Grid]) -> float:
    """Mean distance of neighbouring corners in both views."""
    steps = [
        np.linalg.norm(np.diff(grid.corners, axis=axis), axis=-1).ravel()
        for grid in grids.values()
        for axis in (0, 1)
    ]
    return float(np.nanmean(np.concatenate(steps)))


# Per cm^2, of the paper's Table I: measured markers and virtual ones.
PAPER = (189.0, 2078.0)
PEERS = {"GelForce, 2 layers of 120": 240.0, "GelSight": 83.0, "Tactip": 178.0}
STATE_WORDS = {"rest": "at rest", "press": "under the press"}
M2_PER_CM2 = 1e-4
PARTS = ("corners", "virtual")


def report(results: Results, folder: Path) -> Report:
    """How dense the information is."""
    data = results["prototype"]
    corners, virtual = densities(data)
    depth, force = number(data, "depth") * 1e3, number(data, "normal_force")
    area = number(data, "area") / M2_PER_CM2
    blocks = (
        prose(
            "density",
            "count",
            count=number(data, "corners"),
            count_virtual=number(data, "virtual"),
            area=area,
            corners=corners,
            virtual=virtual,
        ),
        _densities(data),
        prose("density", "measured", depth=depth, force=force),
        _measured(data),
        Figure(
            _picture(data, folder / "density.png"),
            "Markers per cm2. Ours measured: corners and virtual markers that both counts and "
            "status `MEASURED` hold for, in the image of one view under the press, and in space. "
            "The figures of the other sensors are those of the paper's Table I.",
        ),
    )
    return Report(blocks, _claims(data), deviations("density"))


def densities(data: Arrays) -> tuple[float, float]:
    """Corners and virtual markers per cm^2."""
    area = number(data, "area") / M2_PER_CM2
    return number(data, "corners") / area, number(data, "virtual") / area


def _densities(data: Arrays) -> Table:
    corners, virtual = densities(data)
    gel = number(data, "area") / M2_PER_CM2 / 4.84
    rows = (
        ("CMP here, on the area of the print", f"{corners:.0f}", f"{virtual:,.0f}"),
        (
            "CMP here, on the whole gel, 22 mm x 22 mm",
            f"{corners * gel:.0f}",
            f"{virtual * gel:,.0f}",
        ),
        ("CMP in the paper (Tac3D)", f"{PAPER[0]:.0f}", f"{PAPER[1]:,.0f}"),
        ("DMP here, a dot in the place of each corner", f"{corners:.0f}", "0"),
        *((name, f"{value:.0f}", "0") for name, value in PEERS.items()),
    )
    return Table(("Per cm2", "measured markers", "virtual markers"), rows)


def _measured(data: Arrays) -> Table:
    rows = tuple(_measured_row(data, method, state) for method in METHODS for state in STATES)
    draws = len(data["cmp_rest_space"])
    head = (
        "Method",
        "gel",
        "corners measured",
        "virtual measured in a view",
        "virtual per cm2",
        "RMS across the gridline",
        "RMS of corners",
        "virtual measured in 3-D",
    )
    caption = f"Of both views, {draws} draws of noise; the shares are means over draws."
    return Table(head, rows, caption)


def _measured_row(data: Arrays, method: Method, state: str) -> tuple[str, ...]:
    key = f"{method.key}_{state}"
    share = _share(data, f"{key}_virtual")
    return (
        method.label,
        STATE_WORDS[state],
        _percent(_share(data, f"{key}_corners")),
        _percent(share),
        f"{share * densities(data)[1]:,.0f}",
        _length(data, f"{key}_error"),
        _length(data, f"{key}_corner_error"),
        _percent(_share(data, f"{key}_space")),
    )


def _share(data: Arrays, name: str) -> float:
    return float(np.mean(data[name]))


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _length(data: Arrays, name: str) -> str:
    """RMS in px, and on the gel at the mean scale of the views."""
    rms = float(np.sqrt(np.mean(np.square(data[name]))))
    area, corners = number(data, "area"), number(data, "corners")
    pitch = np.sqrt(area) / (np.sqrt(corners) + 1)
    return f"{rms:.4f} px, {1e6 * rms * pitch / number(data, 'pitch_px'):.2g} um"


def _picture(data: Arrays, path: Path) -> Path:
    apply()
    from matplotlib import pyplot as plt

    corners, virtual = densities(data)
    bars: dict[str, tuple[float, float, str]] = {
        "CMP, paper": (*PAPER, PAPER_COLOUR),
        "CMP here, counted": (corners, virtual, COLOURS[CMP.key]),
    }
    for method in METHODS:
        seen, filled = (_share(data, f"{method.key}_press_{what}") for what in PARTS)
        label = f"{method.label}, measured"
        bars[label] = (corners * seen, virtual * filled, COLOURS[method.key])
        if method is CMP:
            seen, filled = (_share(data, f"cmp_press_{what}") for what in ("corners", "space"))
            bars["CMP, measured in 3-D"] = (corners * seen, virtual * filled, COLOURS[method.key])
    bars["DMP here"] = (corners, 0.0, COLOURS["dmp_grid"])
    bars |= {name: (value, 0.0, PAPER_COLOUR) for name, value in PEERS.items()}
    figure, axes = plt.subplots(figsize=(9.0, 3.4))
    for place, (one, other, colour) in enumerate(reversed(bars.values())):
        axes.barh(place, one, color=colour)
        axes.barh(place, other, left=one, color=colour, alpha=0.45)
        text = f"{one:.0f} + {other:,.0f}" if other else f"{one:.0f}"
        axes.text(one + other + 25, place, text, va="center")
    axes.set_yticks(range(len(bars)), list(reversed(bars)))
    axes.set_xlabel("markers per cm²: corners or dots (solid), virtual markers (light)")
    axes.set_xlim(0, 1.18 * max(one + other for one, other, _ in bars.values()))
    axes.grid(visible=False, axis="y")
    return save(figure, path)


def _claims(data: Arrays) -> tuple[Claim, ...]:
    corners, virtual = densities(data)
    share = _share(data, f"{CMP.key}_press_virtual")
    most = max(PEERS.values())
    return (
        Claim(
            "Table I",
            "information density of CMP, markers + virtual markers per cm2 of the print",
            f"{PAPER[0]:.0f} + {PAPER[1]:,.0f}",
            f"{corners:.0f} + {virtual:,.0f}, {virtual * share:,.0f} measured under a press",
            met=bool(corners >= PAPER[0] and share * virtual >= PAPER[1]),
        ),
        Claim(
            "Table I",
            "denser than GelForce, GelSight and Tactip",
            "189 + 2,078 against 120 x 2, 83 and 178",
            f"with virtual markers {corners + share * virtual:,.0f}; corners alone, {corners:.0f}, "
            f"are {'more' if corners > most else 'fewer'} than GelForce's two layers",
            met=bool(corners + share * virtual > most),
        ),
    )


EXPERIMENT = Experiment(
    key="density",
    section="Table I",
    title="Information density",
    cases=cases,
    report=report,
)
