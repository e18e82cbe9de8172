"""Draws docs/images/force_covariance.png: how a traction of a simulated grasp gets its covariance.

`setup/run python3 docs/drawings/force_covariance.py`
"""

from __future__ import annotations

import io
from itertools import islice
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing import ForceModel, Pipeline
from cmp_tactile_processing.force.contact_traction import TractionPosterior
from cmp_tactile_processing.force.measurements import Whitening
from cmp_tactile_processing.force.solution import ForceSolution, ForceSolver
from cmp_tactile_processing.force.traction_spectrum import (
    WEIGHTS,
    TractionSpectrum,
    nodal_force_matrix,
    smoothness,
)
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_simulation.recording.run import recording_of
from cmp_tactile_simulation.scenes.file import load_scene

mpl.use("agg")
from matplotlib import pyplot as plt

PICTURE = Path(__file__).parents[1] / "images" / "force_covariance.png"
SCENE, FRAME = "grasp", 25
BLUE, ORANGE, GREY = "#0072b2", "#d55e00", "#888888"
COLOURS = 96

Float = NDArray[np.float64]


def draw_evidence(axes: Any, evidence: Float, threshold: float) -> None:
    """Log evidence of the first pass over the weight of its prior."""
    best = int(np.argmax(evidence))
    axes.semilogx(WEIGHTS, evidence, color=BLUE)
    axes.plot(WEIGHTS[best], evidence[best], "o", color=ORANGE)
    axes.axhline(threshold, color=GREY, ls=":")
    axes.annotate("contact_evidence", (WEIGHTS[0], threshold), va="bottom", color=GREY)
    axes.set_xlabel("weight of the prior, relative")
    axes.set_ylim(-0.1 * evidence.max(), 1.1 * evidence.max())
    axes.set_title("1. First pass: log evidence of a traction", loc="left")


def draw_nodes(axes: Any, force: Float, nodes: SurfaceGrid, title: str) -> Any:
    """Normal nodal forces in mN."""
    x, y = 1e3 * nodes.x, 1e3 * nodes.y
    shown = -1e3 * force[:, 2].reshape(nodes.rows, nodes.cols)
    mesh = axes.pcolormesh(x, y, shown, cmap="viridis", shading="nearest")
    axes.set_aspect("equal")
    axes.set_title(title, loc="left")
    axes.set_xlabel("x, mm")
    return mesh


def draw_mask(axes: Any, posterior: TractionPosterior, nodes: SurfaceGrid) -> None:
    """Nodes of the second pass; open rings for those of the edge."""
    place = np.array([(1e3 * x, 1e3 * y) for y in nodes.y for x in nodes.x])[posterior.nodes]
    inner, edge = np.split(place, [len(place) - posterior.edge])
    axes.plot(*inner.T, ".", ms=5, color="white")
    axes.plot(*edge.T, "o", ms=5, mfc="none", color=ORANGE)


def draw_budget(axes: Any, shares: dict[str, float]) -> None:
    """Standard deviations of the normal force, mN."""
    axes.barh(list(shares), [1e3 * value for value in shares.values()], color=BLUE)
    axes.invert_yaxis()
    axes.set_xlabel("standard deviation of Fz, mN")
    axes.set_title("4. Parts of the covariance of the wrench", loc="left")
    axes.bar_label(axes.containers[0], fmt="%.1f", padding=2)
    axes.margins(x=0.15)


def deviations(solver: ForceSolver, solution: ForceSolution, place: Float) -> dict[str, float]:
    """Standard deviation of Fz by noise, and by weights and edge, N."""
    posterior = solution.posterior
    assert posterior is not None  # noqa: S101  the grasp is a contact
    functionals = solver.functionals(place, [np.arange(len(place))], posterior.nodes)
    noise, doubt = posterior.covariances(functionals)
    return {"noise": float(np.sqrt(noise[2, 2])), "weights and edge": float(np.sqrt(doubt[2, 2]))}


def main() -> None:
    """Four panels: evidence, first pass, second pass, budget."""
    sensor = load_scene(SCENE).sensor
    pipeline = Pipeline(sensor)
    images = [item.image for item in islice(BagReader(recording_of(SCENE)).frames(), FRAME + 1)]
    pipeline.set_reference(images[:1])
    surface = pipeline.process(images[FRAME]).surface

    model = ForceModel(sensor)
    elastic, parameters = model.elastic, sensor.force
    markers, nodes = elastic.markers, elastic.nodes
    whitening = Whitening(sensor, markers)
    response = elastic.compliance / whitening.noise[:, None]
    solver = ForceSolver(markers, nodes, response, parameters)
    seen = whitening.measurements(surface.displacement, surface.status, surface.covariance)
    solution = solver.solve(seen.data, seen.known)
    prior, lumped = smoothness(nodes, parameters.smoothing_length), nodal_force_matrix(nodes)
    spectrum = TractionSpectrum(markers, nodes, response, prior, lumped)
    evidence = np.array([spectrum.solve(seen.data, seen.known, w).evidence for w in WEIGHTS])
    field = model.reconstruct(
        surface.displacement, surface.status, surface.covariance, systematics=surface.systematics
    )
    moved = elastic.node_displacement(solution.coefficient)
    shares = deviations(solver, solution, elastic.node_position + moved)
    random, systematic = field.random_std[2], field.systematic_std[2]
    known = sum(value**2 for value in shares.values())
    shares |= {"model_error": float(np.sqrt(max(random**2 - known, 0.0)))}
    shares |= {"systematic": float(systematic), "all": float(field.wrench_std[2])}

    figure, panels = plt.subplots(2, 2, figsize=(10, 7.2), layout="constrained")
    draw_evidence(panels[0, 0], evidence, parameters.contact_evidence)
    first = lumped @ solution.first.coefficient.reshape(-1, 3)
    title = "2. First pass: normal nodal forces, mN"
    figure.colorbar(draw_nodes(panels[0, 1], first, nodes, title), ax=panels[0, 1])
    title = "3. Second pass, mN; rings: the edge of the nodes"
    figure.colorbar(draw_nodes(panels[1, 0], solution.force, nodes, title), ax=panels[1, 0])
    assert solution.posterior is not None  # noqa: S101
    draw_mask(panels[1, 0], solution.posterior, nodes)
    draw_budget(panels[1, 1], shares)
    for axes in panels.flat:
        axes.spines[["top", "right"]].set_visible(False)
    kept = io.BytesIO()
    figure.savefig(kept, dpi=90)
    Image.open(kept).convert("RGB").quantize(COLOURS).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
