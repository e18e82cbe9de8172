"""Error of a rig with plate and gel if triangulation ignores their refraction.

Run it in the environment of the repository: `setup/run python3 docs/examples/refraction.py`
"""

from __future__ import annotations

import sys
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.sensor.parts import RefractingLayer
from cmp_tactile_processing.stereo.triangulation import common_normal

PLATE, PLATE_INDEX, GEL_INDEX = 3e-3, 1.49, 1.41
PRESS = 1e-3

Views = dict[str, ViewGeometry]


def main(name: str = "sample_rig") -> None:
    """Print the errors of three models of the same rays."""
    sensor = load_sensor(name)
    thickness = sensor.elastomer.size[2] - sensor.elastomer.shading_layer.thickness
    layers = (
        RefractingLayer(-thickness - PLATE, PLATE_INDEX),
        RefractingLayer(-thickness, GEL_INDEX),
    )
    true = build_views(replace(sensor, optics=replace(sensor.optics, layers=layers)))
    rest = sensor.pattern.corners().reshape(-1, 3)
    pressed = rest.copy()
    pressed[:, 2] -= PRESS * np.exp(-(rest[:, :2] ** 2).sum(axis=1) / (2 * 2e-3**2))
    dropped = {name: replace(view, layers=()) for name, view in true.items()}
    fitted = {name: _fitted(view, rest, true[name].project(rest)) for name, view in dropped.items()}

    print("layers of the model           at rest, um            pressed by 1 mm, um")
    print("                        depth     error   ray gap    depth too small   error")
    models = {"those of the rig": true, "none": dropped, "none, poses fitted": fitted}
    for label, model in models.items():
        at_rest, gap = _seen(true, model, rest)
        moved = _seen(true, model, pressed)[0] - at_rest
        error, off = at_rest - rest, moved - (pressed - rest)
        deepest = np.argmin(pressed[:, 2] - rest[:, 2])
        figures = [error[:, 2].mean(), _length(error), gap.mean(), off[deepest, 2], _length(off)]
        depth, size, gaps, press, displacement = (1e6 * value + 0.0 for value in figures)
        print(f"{label:20s} {depth:8.2f} {size:9.2f} {gaps:9.2f} {press:18.2f} {displacement:7.2f}")


def _seen(
    true: Views, model: Views, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (N, 3) and ray gaps (N,) that the model triangulates from the true pixels."""
    left, right = (model[name].rays(true[name].project(points)) for name in ("left", "right"))
    return common_normal(*left, *right)


def _fitted(
    view: ViewGeometry, points: NDArray[np.float64], q: NDArray[np.float64]
) -> ViewGeometry:
    """The view with the pose that fits these points best to the pixels q (N, 2)."""
    start = view.T_view_gel
    _, turn, shift = cv2.solvePnP(
        points,
        q,
        view.lens.matrix,
        view.lens.distortion,
        cv2.Rodrigues(start[:3, :3])[0],
        start[:3, 3].copy(),
        useExtrinsicGuess=True,
    )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return replace(view, T_view_gel=T)


def _length(vectors: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(vectors, axis=1).mean())


if __name__ == "__main__":
    main(*sys.argv[1:])
