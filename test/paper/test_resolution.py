"""Section IV.E: where pairs of spheres lie, and what is claimed of made-up results."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cmp_tactile_simulation.scenes.file import load_scene
from paper.experiments.resolution import (
    LAYOUTS,
    RADIUS,
    claims,
    pair_scene,
    pairs_of,
)
from paper.page import Page
from paper.readings import READINGS

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


def spheres(cmp_um: float, dots_um: float, cmp_share: float) -> dict[str, Any]:
    line = np.linspace(-6e-3, 6e-3, 41)
    nodes = np.stack(np.meshgrid(line, line), axis=-1)
    true = np.zeros((*nodes.shape[:2], 3))
    true[20, 20, 2] = -1e-4
    made: dict[str, Any] = {
        "centres": np.array([[0.0, 0.0]] * 5),
        "nodes": nodes,
        "true": true,
        "corner_xy": nodes[::8, ::8].reshape(-1, 2),
        "virtual_xy": nodes[::8].reshape(-1, 2),
    }
    for reading in READINGS:
        off = 1e-6 * (cmp_um if reading.key == "cmp" else dots_um)
        share = cmp_share if reading.key == "cmp" else 0.7
        made |= {
            f"{reading.key}_field": true,
            f"{reading.key}_near": np.array([off, off]),
            f"{reading.key}_all": np.array([off, off]),
            f"{reading.key}_share": np.full((2, 5), share),
        }
    return made


def pairs(cmp_dip: float, dots_dip: float) -> dict[str, Any]:
    """At 1 mm these dips; at 2 mm all are distinguished, and a single sphere is one."""
    made: dict[str, Any] = {
        "separation": np.repeat([0.0, 1e-3, 2e-3], 4),
        "true": np.repeat([0.0, 0.3, 0.6], 4),
    }
    for reading in READINGS:
        dip = cmp_dip if reading.key == "cmp" else dots_dip
        made[f"{reading.key}_dip"] = np.repeat([0.0, dip, 0.5], 4)[:, None]
    return made


@pytest.mark.parametrize(
    ("cmp_um", "share", "dip", "met"),
    [
        (5.0, 0.9, 0.3, [True, True, True]),
        (12.0, 0.7, 0.2, [False, False, False]),
        (5.0, 0.6, 0.3, [True, False, True]),
        # Ahead by less than a tenth.
        (11.5, 0.75, 0.3, [False, False, True]),
    ],
)
def test_claims_are_met_where_cmp_does_better(
    cmp_um: float, share: float, dip: float, met: list[bool], tmp_path: Path
) -> None:
    page = Page(tmp_path)
    claims(spheres(cmp_um, 12.0, share), pairs(dip, 0.2), page)
    assert [claim.met for claim in page.claims] == met
    smallest = "1.0" if dip > 0.265 else "2.0"
    assert f"resolved from {smallest} mm on" in page.claims[2].ours
