"""Makes what all workers take from the caches, before they begin: a process of `pytest -n`.

Else each of them would compile the same functions, or wait for the other's recording.  Beside it,
another process compiles the trackers, which takes longest.
"""

from __future__ import annotations

import numpy as np

from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.recording.run import recording_of
from cmp_tactile_simulation.recording.truth import read_truth


def main() -> None:
    """The recordings of the short scenes, and forces of one."""
    sensor = load_sensor("sample_rig")
    for scene in ("weigh", "grasp"):
        bag = recording_of(scene)
    model, corners = ForceModel(sensor), read_truth(bag).corners_m
    for frame in corners:
        model.reconstruct(frame - corners[0], np.isfinite(frame).all(axis=-1).astype(np.uint8))


if __name__ == "__main__":
    main()
