#!/usr/bin/env python3
"""Write the true forces of test/test_force_accuracy.py, from the cases of the benchmark."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from cases import (
    CONTACTS,
    LINEAR,
    TRUTH_NODES,
    ForceCase,
    load_cases,
    load_neo_hookean_cases,
    pressed,
)
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.gel import LinearElastomer

DEFAULT = Path(__file__).parents[2] / "test" / "data" / "force_truth.npz"
SENSOR = "sample_rig"
CHOSEN = (
    ("sphere", 1.0),
    ("sphere", 10.0),
    ("two contacts", 1.0),
    ("off centre", 10.0),
    ("shear", 10.0),
    ("torque", 1.0),
)
# A flat pin, and its depth, m.
NEO_HOOKEAN = ("flat", 0.44e-3)
RENDERED_N = 2.0


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path, nargs="?", default=DEFAULT, help="output file")
    path = parser.parse_args().path
    sensor = load_sensor(SENSOR)
    cases = {(case.name, case.newton): case for case in load_cases(sensor)
             if case.material == LINEAR}  # fmt: skip
    found = _arrays([cases[key] for key in CHOSEN])
    pressed_far = next(
        case for case in load_neo_hookean_cases(sensor) if (case.name, case.depth) == NEO_HOOKEAN
    )
    found |= {f"neo_hookean_{key}": values for key, values in _arrays([pressed_far]).items()}
    gel = LinearElastomer(sensor, TRUTH_NODES)
    state = next(pressed(gel, CONTACTS["sphere"], (RENDERED_N,)))
    place = gel.node_position + state.displacement
    found |= {
        "rendered_displacement": gel.marker_displacement(state.force).astype(np.float32),
        "rendered_wrench": np.concatenate(
            [state.resultant, np.cross(place, state.force).sum(axis=0)]
        ),
        "material": np.array([sensor.elastomer.young, sensor.elastomer.poisson]),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **found)
    print(f"{path}, {path.stat().st_size / 1e3:.0f} kB")


def _arrays(cases: list[ForceCase]) -> dict[str, NDArray[np.generic]]:
    return {
        "name": np.array([case.name for case in cases]),
        "newton": np.array([case.newton for case in cases]),
        "displacement": np.array([case.displacement for case in cases], dtype=np.float32),
        "force": np.array([case.force_on_nodes for case in cases], dtype=np.float32),
        "wrench": np.array([case.wrench for case in cases]),
    }


if __name__ == "__main__":
    main()
