#!/usr/bin/env python3
"""Time of a frame over the number of corners: tracking, triangulation, force, and all together.

Patterns of N x N corners of the same size on the sample rig (1024 px) show the same press of a
sphere, held while it grows a little. `growth` is the exponent of each time in the number of
corners. Tracking of a view, triangulation and force are processor times of one thread. The whole is
elapsed time, with both views tracked at once. A part of each time does not depend on the pattern.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pipeline_speed as speed
from matplotlib import pyplot as plt
from numpy.typing import NDArray
from pipeline_speed import WARM_UP, Chain, Times
from tables import CommandLine

from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.gel import LinearElastomer
from cmp_tactile_simulation.indenter_shapes import Sphere
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from hard_frames.studio import pattern_rig
from paper.sequence import PrintedGel

RESULTS = Path(__file__).parent / "results"
RADIUS, FRICTION, CONTACT_NODES = 6e-3, 0.6, 32
DEPTHS = np.linspace(3e-4, 5e-4, 12)
FOLLOWED = "a view, followed"
# What is kept, and how its names begin among all times.
NAMES = {
    "a view, from scratch": speed.SCRATCH,
    FOLLOWED: speed.FOLLOWED,
    "triangulation": speed.TRIANGULATION,
    "force and slip": speed.FORCE,
    "frame to force (clock)": speed.CLOCK,
}
# Corners along a side, and from which on the pattern counts for more than the image.
SIDES, LARGE = (10, 14, 20, 28, 36, 48, 60), 28


def presses() -> tuple[LinearElastomer, list[NDArray[np.float64]]]:
    """The gel, and the displacement of its marker surface at each depth, m."""
    gel = LinearElastomer(load_sensor("sample_rig"), CONTACT_NODES)
    contact = ContactSimulation(gel, Sphere(RADIUS), FRICTION)
    state = contact.rest(contact.touch(Pose(np.array([0.0, 0.0, 2 * RADIUS]))))
    start, moved = state.pose.position, []
    for depth in DEPTHS:
        state = contact.move(state, Pose(start - [0, 0, depth]))
        moved.append(gel.marker_displacement(state.force))
    return gel, moved


def frames_of(
    rig: SensorDescription, gel: LinearElastomer, moved: list[NDArray[np.float64]]
) -> list[NDArray[np.uint8]]:
    """What the camera sees of each depth."""
    camera = PrintedGel(rig, "cmp")
    surfaces = (DeformedSurface(rig.pattern, gel.observers, one) for one in moved)
    return [camera.image(surface, number) for number, surface in enumerate(surfaces)]


def figures_of(times: Times) -> dict[str, float]:
    """Medians, ms, by the names that are kept; all frames are in contact."""
    found = {name: [] for name in NAMES}
    for name, seconds in times.found.items():
        for kept, beginning in NAMES.items():
            if name.startswith(beginning):
                found[kept] += seconds
    return {name: round(1e3 * float(np.median(one)), 2) for name, one in found.items()}


def growth(figures: dict[str, dict[str, float]], least: int = 0) -> dict[str, float]:
    """Exponent of each time in the corners, fitted to patterns of at least so many along a side."""
    sides = [side for side in figures if int(side) >= least]
    corners = np.log([int(side) ** 2 for side in sides])
    return {
        name: round(float(np.polyfit(corners, np.log([figures[s][name] for s in sides]), 1)[0]), 3)
        for name in NAMES
    }


def draw(result: dict[str, dict[str, Any]], path: Path) -> None:
    """Times over corners, with a line of slope one."""
    figures = result["median_ms"]
    corners = np.array([int(side) ** 2 for side in figures])
    figure, axes = plt.subplots(figsize=(7.0, 4.8), layout="constrained")
    for name, exponent in result["growth"].items():
        times = [row[name] for row in figures.values()]
        label = f"{name}: ^{exponent:.2f}, from {LARGE}²: ^{result['growth_of_large'][name]:.2f}"
        axes.loglog(corners, times, "o-", ms=4, label=label)
    tracked = figures[str(max(map(int, figures)))][FOLLOWED] * corners / corners.max()
    axes.loglog(corners, tracked, ":", color="grey", label="linear in corners")
    axes.axhline(1e3 / 30, color="grey", lw=0.8, label="30 Hz")
    axes.set_xticks(corners, [f"{side}²" for side in figures], minor=False)
    axes.minorticks_off()
    axes.set(xlabel="corners of the pattern", ylabel="median of a frame, ms", ylim=(0.3, 150))
    axes.legend(frameon=False, fontsize=8, loc="upper left", ncols=2)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Measure, print, and keep."""
    parser = CommandLine(__doc__)
    parser.option("--rounds", "repetitions", 5)
    parser.option("--output", "folder for growth.json and growth.png", RESULTS, type=Path)
    arguments = parser.parse_args()
    gel, moved = presses()
    rigs = {str(side): pattern_rig(side, side) for side in SIDES}
    chains = {side: Chain(rig) for side, rig in rigs.items()}
    frames = {side: frames_of(rig, gel, moved) for side, rig in rigs.items()}
    found = {side: Times() for side in chains}
    # All in each round, so that a machine that slows down slows down all of them.
    for round_number in range(arguments.rounds + 1):
        for side, chain in chains.items():
            chain.reset()
            for number, frame in enumerate(frames[side]):
                counts = round_number and number >= WARM_UP
                chain.measure(frame, number, found[side] if counts else Times())
    figures = {side: figures_of(times) for side, times in found.items()}
    result: dict[str, dict[str, Any]] = {"median_ms": figures, "growth": growth(figures)}
    result["growth_of_large"] = growth(figures, LARGE)
    text = json.dumps(result, indent=1)
    print(text)
    (arguments.output / "growth.json").write_text(text + "\n", encoding="utf-8")
    draw(result, arguments.output / "growth.png")


if __name__ == "__main__":
    main()
