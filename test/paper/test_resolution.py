"""Section IV.E: where pairs of spheres lie."""

import numpy as np
import pytest

from cmp_tactile_simulation.scenes.file import load_scene
from paper.experiments.resolution import (
    LAYOUTS,
    RADIUS,
    pair_scene,
    pairs_of,
)

PATTERN = load_scene("resolution_spheres").sensor.pattern


def test_pairs_differ_in_direction_and_stay_on_the_print() -> None:
    pairs = [pair for layout in range(LAYOUTS) for pair in pairs_of(layout, PATTERN.pitch)]
    angles = sorted(pair.angle for pair in pairs)
    assert np.diff(angles) == pytest.approx(np.full(len(pairs) - 1, np.pi / len(pairs)))
    half = (PATTERN.cols - 1) / 2 * PATTERN.pitch
    for pair in pairs:
        ends = pair.ends(3e-3)
        assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(3e-3)
        assert ends.mean(axis=0) == pytest.approx(pair.middle)
        assert np.abs(ends).max() + 0.4e-3 < half


def test_spheres_of_pairs_touch_the_gel_together() -> None:
    scene = pair_scene(1, 1.5e-3)
    centres = np.array(scene.indenter.values["centres"])
    radius = PATTERN.surface.radius + scene.sensor.elastomer.shading_layer.thickness + RADIUS
    to_middle = np.linalg.norm(centres + (0, 0, radius), axis=1)
    assert to_middle == pytest.approx(np.full(8, radius), rel=1e-9)
    assert len(pair_scene(1, 0.0).indenter.values["centres"]) == 4
