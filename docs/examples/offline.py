"""From recorded frames to force, in a script or a notebook, without ROS.

Run it in the environment of the repository: `setup/run python3 docs/examples/offline.py`
"""

from __future__ import annotations

import sys
from itertools import islice
from pathlib import Path

import numpy as np

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing import Pipeline, SensorDescription
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_simulation.recording.run import recording_of


def main(bag: Path | None = None) -> None:
    """Print depth and force of every fifth frame; the bag has a sensor.yaml in its folder."""
    bag = bag or recording_of("grasp")  # the first run simulates it
    frames = [recorded.image for recorded in BagReader(bag).frames()]
    # The first run builds the force model of the sensor.
    pipeline = Pipeline(SensorDescription.load(bag / "sensor.yaml"))
    pipeline.set_reference(frames[:2])  # the gel is at rest in these

    print("frame   corners   deepest / mm   force on the gel / N")
    for number, frame in islice(enumerate(frames), 0, None, 5):
        result = pipeline.process(frame)
        deepest = -1e3 * np.nanmin(result.surface.displacement[..., 2])
        fx, fy, fz = result.force.wrench[:3]
        corners = int((result.surface.status == 1).sum())
        print(f"{number:5d} {corners:9d} {deepest:14.2f}   {fx:7.2f} {fy:7.2f} {fz:7.2f}")


if __name__ == "__main__":
    try:
        main(*map(Path, sys.argv[1:]))
    except CmpTactileError as error:
        sys.exit(f"error: {error}")
