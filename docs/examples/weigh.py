"""Weighs objects on the gel: prints the weight in a recording, with its error bar.

Run it in the environment of the repository:
`setup/run python3 docs/examples/weigh.py BAG [SENSOR.yaml [PICTURE.png]]`
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing import Pipeline, SensorDescription
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_simulation.recording.truth import read_truth

GRAVITY = 9.80665
GRAMS_PER_NEWTON = 1e3 / GRAVITY
REST_FRAMES = 3  # nothing touches the gel in the first frames


def weigh(bag: Path, sensor: SensorDescription) -> NDArray[np.float64]:
    """Weight and its standard deviation for each frame, (n, 2) g."""
    frames = list(BagReader(bag).frames())
    pipeline = Pipeline(sensor)  # the first run builds the force model of the sensor
    pipeline.set_reference(frame.image for frame in frames[:REST_FRAMES])
    weights = []
    for frame in frames:
        force = pipeline.process(frame.image, frame.stamp_ns).force
        # A weight presses along -z, into the gel.
        weights.append((0 - force.wrench[2], force.wrench_std[2]))
    return GRAMS_PER_NEWTON * np.array(weights)


def draw(read: NDArray[np.float64], true: NDArray[np.float64], picture: Path) -> None:
    """Plot the reading with twice its standard deviation, and the truth."""
    mpl.use("agg")
    from matplotlib import pyplot as plt

    figure, (whole, left) = plt.subplots(2, 1, sharex=True, figsize=(9, 6), layout="constrained")
    number, (weight, std) = np.arange(len(read)), read.T
    for axes, zero in ((whole, 0 * true), (left, true)):
        axes.plot(number, true - zero, color="black", lw=1, label="true")
        axes.plot(number, weight - zero, "o-", ms=3, color="#d55e00", label="read")
        low, high = weight - zero - 2 * std, weight - zero + 2 * std
        axes.fill_between(number, low, high, alpha=0.3, color="#d55e00", label="± 2 std")
    whole.set_title("What rests on the gel, read from its surface", loc="left", weight="bold")
    whole.set_ylabel("weight, g")
    left.set_ylabel("read minus true, g")
    left.set_xlabel("frame")
    whole.legend(loc="upper left")
    figure.savefig(picture, dpi=100)


def main(bag: Path, sensor: Path | None = None, picture: Path | None = None) -> None:
    """Print the weight in every third frame of a simulated recording, and the true weight."""
    read = weigh(bag, SensorDescription.load(sensor or bag / "sensor.yaml"))
    true = 0 - GRAMS_PER_NEWTON * read_truth(bag).wrench[:, 2]

    print("frame   read / g   2 std / g   true / g")
    for number in range(0, len(read), 3):
        weight, std = read[number]
        print(f"{number:5d} {weight:10.1f} {2 * std:11.1f} {true[number]:10.1f}")
    if picture:
        draw(read, true, picture)


if __name__ == "__main__":
    try:
        main(*map(Path, sys.argv[1:]))
    except CmpTactileError as error:
        sys.exit(f"error: {error}")
