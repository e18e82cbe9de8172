"""Table I: markers per square centimetre, and how many of them are really measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import Status
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Scene
from hard_frames.grid_score import GridScore, join_scores
from paper.chain import CMP, CMP_PAPER, Chain, Method, score_markers
from paper.lab import Arrays, Lab, Workplace, mechanics_of, shortened
from paper.page import Page
from paper.sequence import RenderedSequence

METHODS = (CMP, CMP_PAPER)
STATES = {"rest": "at rest", "press": "under the press"}
SCENE = "ball:20mm"
TITLE = "Table I: Information density"
# Per cm^2, of the paper's Table I: measured markers and virtual ones.
PAPER = (189.0, 2078.0)
PEERS = {"GelForce, 2 layers of 120": 240.0, "GelSight": 83.0, "Tactip": 178.0}
M2_PER_CM2 = 1e-4


def run(lab: Lab, page: Page) -> None:
    """Count markers at rest and under a ball, and report."""
    (data,) = lab.compute(count_markers, [(SCENE, 2 if lab.fast else 10)])
    corners, virtual = densities(data)
    page.prose(
        "density", "count", count=data["corners"], count_virtual=data["virtual"],
        area=data["area"] / M2_PER_CM2, corners=corners, virtual=virtual,
    )  # fmt: skip
    page.rows(
        ("Per cm2", "measured markers", "virtual markers"),
        (
            ("CMP here, on the area of the print", f"{corners:.0f}", f"{virtual:,.0f}"),
            ("CMP in the paper (Tac3D)", f"{PAPER[0]:.0f}", f"{PAPER[1]:,.0f}"),
            ("DMP here, a dot in the place of each corner", f"{corners:.0f}", "0"),
            *((name, f"{value:.0f}", "0") for name, value in PEERS.items()),
        ),
    )
    page.prose("density", "measured", depth=1e3 * data["depth"], force=data["normal_force"])
    rows = [_row(data, method, state) for method in METHODS for state in STATES]
    page.table("density.measured", rows)
    claims(data, page)
    page.departures("density")


def printed_area(pattern: Pattern) -> float:
    """Of all checkers that the corners belong to, laid flat, m^2."""
    return (pattern.rows + 1) * (pattern.cols + 1) * pattern.pitch**2


def virtual_count(pattern: Pattern) -> int:
    """Virtual markers of a view."""
    shape = pattern.shape
    return int(np.prod(shape.row_lines) + np.prod(shape.col_lines))


def count_markers(place: Workplace, name: str, draws: int) -> dict[str, Any]:
    """Markers that are measured, by method and state.

    KEY_STATE (draws, 3): shares of the corners and of the virtual markers that are measured in the
    two views, and of the latter in 3-D.  KEY_STATE_rms (2,): distances of measured virtual markers
    across their true gridlines and of corners from theirs, px.  corners, virtual: in all.
    area, m^2.  depth, m, and normal_force, N: of the press.
    """
    frames = {"rest": 1, "press": 2 if place.fast else 6, "hold": 1}
    scene = shortened(name, frames, fast=place.fast)
    pattern = scene.sensor.pattern
    mechanics = mechanics_of(scene, place)
    pressed = int(mechanics.frames("hold")[-1])
    surfaces = [DeformedSurface.rest(pattern), mechanics.surface(pressed, pattern)]
    sequence = RenderedSequence(scene.sensor, surfaces, "cmp")
    found: dict[str, Any] = {
        "corners": float(np.prod(pattern.shape.corners)),
        "virtual": float(virtual_count(pattern)),
        "area": printed_area(pattern),
        "depth": -float(mechanics.displacement[pressed, ..., 2].min()),
        "normal_force": -float(mechanics.wrench[pressed, 2]),
    }
    for method in METHODS:
        found |= _counted(scene, sequence, method, draws)
    return found


def _counted(
    scene: Scene, sequence: RenderedSequence, method: Method, draws: int
) -> dict[str, NDArray[np.float64]]:
    chain = Chain(scene.sensor, method)
    shares: dict[str, list[list[float]]] = {state: [] for state in STATES}
    scores: dict[str, list[GridScore]] = {state: [] for state in STATES}
    for draw in range(draws):
        exposure = sequence.exposed(draw)
        chain.reset()
        chain.set_reference(exposure.rest)
        for index, state in enumerate(STATES):
            found = chain.measure(exposure.frames[index])
            grids, surface = found.grids, found.surface
            corners = [grid.corner_status for grid in grids.values()]
            lines = [x for g in grids.values() for x in (g.row_line_status, g.col_line_status)]
            space = surface.row_status, surface.col_status
            shares[state].append([_measured(part) for part in (corners, lines, space)])
            scores[state].append(score_markers(grids, sequence.truth(index).grids))
    data = {}
    for state in STATES:
        score = join_scores(scores[state])
        rms = [float(np.sqrt(np.mean(off**2))) for off in (score.measured, score.corner)]
        data[f"{method.key}_{state}"] = np.array(shares[state])
        data[f"{method.key}_{state}_rms"] = np.array(rms)
    return data


def _measured(parts: Sequence[NDArray[np.uint8]]) -> float:
    """Share of markers with that status."""
    return float(np.mean(np.concatenate([part.ravel() for part in parts]) == Status.MEASURED))


def densities(data: Mapping[str, Any]) -> tuple[float, float]:
    """Corners and virtual markers per cm^2."""
    area = data["area"] / M2_PER_CM2
    return data["corners"] / area, data["virtual"] / area


def _row(data: Arrays, method: Method, state: str) -> tuple[str, ...]:
    corners, virtual, space = data[f"{method.key}_{state}"].mean(axis=0)
    shares = (f"{100 * share:.1f} %" for share in (corners, virtual, space))
    rms = (f"{value:.4f} px" for value in data[f"{method.key}_{state}_rms"])
    density = f"{virtual * densities(data)[1]:,.0f}"
    return method.label, STATES[state], *shares, density, *rms


def claims(data: Arrays, page: Page) -> None:
    """Compare the paper's densities with ours."""
    corners, virtual = densities(data)
    measured = virtual * float(data[f"{CMP.key}_press"][:, 1].mean())
    values = {"corners": corners, "virtual": virtual, "measured": measured}
    dense = corners >= PAPER[0] and measured >= PAPER[1]
    page.claim("density.density", dense, **values)
    page.claim("density.denser", corners + measured > max(PEERS.values()), **values)
