"""What the pipeline finds in a simulated recording, beside what is true of it."""

import sys
from pathlib import Path

import numpy as np

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing import Pipeline, SensorDescription
from cmp_tactile_simulation.recording.truth import read_truth

bag = Path(sys.argv[1])
truth = read_truth(bag)
pipeline = Pipeline(SensorDescription.load(bag / "sensor.yaml"))
print("frame  corners px RMS  surface um  found Fz N  true Fz N  found Mz N mm  true Mz N mm")
for number, frame in enumerate(BagReader(bag).frames()):
    result = pipeline.process(frame.image)
    if number % 5:
        continue
    off_px = np.stack(
        [
            result.left.corners_frame - truth.corners_left_px[number],
            result.right.corners_frame - truth.corners_right_px[number],
        ]
    )
    rms_px = np.sqrt(np.nanmean((off_px**2).sum(axis=-1)))
    off_m = np.linalg.norm(result.surface.position - truth.corners_m[number], axis=-1)
    found, true = result.force.wrench, truth.wrench[number]
    print(
        f"{number:5d}  {rms_px:14.3f}  {1e6 * np.nanmean(off_m):10.2f}  {found[2]:10.3f}  "
        f"{true[2]:9.3f}  {1e3 * found[5]:13.3f}  {1e3 * true[5]:12.3f}"
    )
