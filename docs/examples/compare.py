"""Compares the results of the pipeline with the truth of a simulated recording.

Run it in the environment of the repository: `setup/run python3 docs/examples/compare.py BAG`
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing import Pipeline, SensorDescription
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_simulation.recording.truth import read_truth


def main(bag: Path) -> None:
    """Print the errors of every fifth frame of a bag that `cmp_tactile simulate` made."""
    truth = read_truth(bag)
    true_px = {"left": truth.corners_left_px, "right": truth.corners_right_px}
    sensor = SensorDescription.load(bag / "sensor.yaml")
    pipeline = Pipeline(sensor)
    # One view measures no depth.
    axes, surface = (3, "surface um") if len(sensor.views) == 2 else (2, "in x, y um")
    print(f"frame  corners px RMS  {surface}  found Fz N  true Fz N  found Mz N mm  true Mz N mm")
    for number, (frame, _) in enumerate(zip(BagReader(bag).frames(), truth.stamp_ns, strict=False)):
        result = pipeline.process(frame.image)
        if number % 5:
            continue
        grids = {"left": result.left, "right": result.right}
        off_px = np.stack(
            [grids[view].corners_frame - true_px[view][number] for view in sensor.views]
        )
        rms_px = np.sqrt(np.nanmean((off_px**2).sum(axis=-1)))
        off_m = (result.surface.position - truth.corners_m[number])[..., :axes]
        off_um = 1e6 * np.nanmean(np.linalg.norm(off_m, axis=-1))
        found, true = result.force.wrench, truth.wrench[number]
        print(
            f"{number:5d}  {rms_px:14.3f}  {off_um:10.2f}  {found[2]:10.3f}  "
            f"{true[2]:9.3f}  {1e3 * found[5]:13.3f}  {1e3 * true[5]:12.3f}"
        )


if __name__ == "__main__":
    try:
        main(*map(Path, sys.argv[1:]))
    except CmpTactileError as error:
        sys.exit(f"error: {error}")
