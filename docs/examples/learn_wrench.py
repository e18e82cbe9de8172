"""Trains a small network from pictures to the wrench; prints its error beside the pipeline's.

It needs PyTorch (`pip install torch`) and a dataset: `cmp_tactile dataset presses --samples 640`
`setup/run python3 docs/examples/learn_wrench.py [presses [FRAMES_OF_EACH_TEST [EPOCHS]]]`
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import xarray
from numpy.typing import NDArray

from cmp_tactile_processing import Pipeline, SensorDescription
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.force.advice import UNUSABLE
from cmp_tactile_simulation.dataset.distribution import Distribution
from cmp_tactile_simulation.dataset.recipe import CameraKeys, Phase, Recipe, load_recipe
from cmp_tactile_simulation.dataset.sampling import Sampler, draw

try:
    import torch
    from torch import nn
    from torch.optim.lr_scheduler import OneCycleLR
except ModuleNotFoundError:
    sys.exit("error: this example needs PyTorch: pip install torch")

Array = NDArray[np.float32]

HELD_OUT_INDENTER = "ring"
TEST_FRAMES, EPOCHS, BATCH = 24, 20, 32
CHANNELS, KERNELS_PX = (2, 16, 32, 64, 64), (5, 3, 3, 3)
MAX_LEARNING_RATE = 3e-3
# The frame is made smaller by this; a checker is 3 px wide then.
SHRINK = 4
# Light is levelled over windows of so many small pixels; grey levels that are no pattern.
WINDOW_PX, FAINT = 17, 5.0
# The rig is symmetric: a frame that is mirrored left to right shows the wrench times this.
MIRRORED = np.array([-1, 1, 1, 1, -1, -1], np.float32)
COLUMNS = ("Fx / mN", "Fy / mN", "Fz / mN", "Mx / mN mm", "My / mN mm", "Mz / mN mm")
UNITS = np.array([1e3, 1e3, 1e3, 1e6, 1e6, 1e6])
OTHER_LIGHT = CameraKeys(
    light_level=Distribution("uniform", (90.0, 130.0)),
    light_ratio=Distribution("uniform", (2.0, 3.0)),
    light_direction=Distribution("uniform", (-3.14, 3.14)),
    blur=Distribution("uniform", (1.2, 1.8)),
    read_noise=Distribution("uniform", (3.0, 6.0)),
    glare_spots=Distribution("choice", (1.0, 2.0, 3.0)),
)
HISTORY = (Phase(name="rest", lift=1e-3), Phase(name="press", shear=1, twist=1))


@dataclass(frozen=True)
class Test:
    """A frame of the gel at rest, one of a press, (H, W) uint8, and its true wrench (6,)."""

    rest: NDArray[np.uint8]
    press: NDArray[np.uint8]
    wrench: NDArray[np.float64]


def features(frame: NDArray[np.uint8]) -> Array:
    """Both views of a frame side by side, small and in level light, (2, h, w)."""
    size = frame.shape[1] // SHRINK, frame.shape[0] // SHRINK
    small = cv2.resize(frame.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    views = []
    for view in np.split(small, 2, axis=1):
        mean, power = (cv2.blur(item, (WINDOW_PX, WINDOW_PX)) for item in (view, view**2))
        contrast = np.sqrt(np.maximum(power - mean**2, 0))
        views.append((view - mean) / (contrast + FAINT))
    return np.stack(views)


def training_samples(folder: Path) -> tuple[Array, Array, NDArray[np.str_]]:
    """Features (N, 2, h, w), wrenches (N, 6) and indenters (N,) of a dataset."""
    images: list[Array] = []
    wrenches, indenters = [], []
    for path in sorted(folder.glob("samples_*.nc")):
        with xarray.open_dataset(path, engine="h5netcdf") as shard:
            images += [features(frame.values) for frame in shard.image]
            wrenches.append(shard.wrench.values)
            indenters.append(shard.indenter.values.astype(str))
    return np.stack(images), np.concatenate(wrenches), np.concatenate(indenters)


def tests_of(recipe: Recipe, first: int, count: int) -> list[Test]:
    """Samples of a recipe from number `first` on, with the gel at rest before each."""
    recipe = replace(recipe, history=HISTORY)
    sampler, tests = Sampler(recipe), []
    # Samples of one variant after another, so that each is built once.
    for number in sorted(range(first, first + count), key=lambda k: k % recipe.variants):
        try:
            rest, press = sampler.frames(draw(recipe, number))
        except CmpTactileError as error:
            print(f"sample {number} is left out: {error}")
            continue
        tests.append(Test(rest.image, press.image, press.truth.wrench))
    return tests


class Network:
    """Four convolutions and a linear layer, from the features of a frame to the wrench."""

    def __init__(self, images: Array, wrenches: Array, epochs: int) -> None:
        """Train with images (N, 2, h, w) and their wrenches (N, 6)."""
        self._scale = wrenches.std(axis=0)
        layers: list[nn.Module] = []
        for (before, after), size in zip(pairwise(CHANNELS), KERNELS_PX, strict=True):
            convolution = nn.Conv2d(before, after, size, stride=2, padding=size // 2)
            layers += [convolution, nn.BatchNorm2d(after), nn.ReLU()]
        self._layers = nn.Sequential(*layers, nn.Flatten(), nn.LazyLinear(6))
        x = torch.from_numpy(np.concatenate([images, images[:, ::-1, :, ::-1]]))
        y = torch.from_numpy(np.concatenate([wrenches, wrenches * MIRRORED]) / self._scale)
        self._layers(x[:2])  # the last layer takes its size from it
        batches = -(-len(x) // BATCH)
        optimizer = torch.optim.AdamW(self._layers.parameters())
        schedule = OneCycleLR(optimizer, MAX_LEARNING_RATE, epochs * batches)
        for _ in range(epochs):
            for chosen in torch.randperm(len(x)).tensor_split(batches):
                loss = nn.functional.mse_loss(self._layers(x[chosen]), y[chosen])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                schedule.step()
        self._layers.eval()

    def wrench(self, test: Test) -> Array:
        """The wrench (6,) of a press less that at rest, N and N m."""
        with torch.inference_mode():
            images = np.stack([features(test.press), features(test.rest)])
            press, rest = self._layers(torch.from_numpy(images)).numpy() * self._scale
        return np.asarray(press - rest)


def measured(sensor: Path, tests: list[Test]) -> tuple[Array, NDArray[np.bool_]]:
    """Wrenches (N, 6), NaN where the pipeline gives none, and which it calls usable (N,)."""
    pipeline = Pipeline(SensorDescription.load(sensor))
    found, usable = np.full((len(tests), 6), np.nan, np.float32), np.zeros(len(tests), bool)
    for number, test in enumerate(tests):
        pipeline.reset()
        try:
            pipeline.set_reference([test.rest])
        except CmpTactileError as error:
            print(f"no reference: {error}")
        else:
            force = pipeline.process(test.press).force
            found[number], usable[number] = force.wrench, not force.flags & UNUSABLE
    return found, usable


def print_errors(title: str, errors: NDArray[np.floating]) -> None:
    """One row of the table: RMS of errors (N, 6) where there are numbers."""
    errors = errors[np.isfinite(errors).all(axis=1)]
    rms = UNITS * np.sqrt((errors**2).sum(axis=0) / max(len(errors), 1))
    values = (f"{value:{len(name)}.1f}" for name, value in zip(COLUMNS, rms, strict=True))
    print(f"  {title:<18}{len(errors):6d}", *values, sep="  ", flush=True)


def main(folder: Path, count: int = TEST_FRAMES, epochs: int = EPOCHS) -> None:
    """Train on the dataset in `folder`, and test with frames that are simulated here."""
    dataset = load_recipe(str(folder / "recipe.yaml"))
    torch.manual_seed(0)
    begun = time.monotonic()
    images, wrenches, indenters = training_samples(folder)
    trained_on = indenters != HELD_OUT_INDENTER
    network = Network(images[trained_on], wrenches[trained_on], epochs)
    print(f"trained on {trained_on.sum()} samples in {time.monotonic() - begun:.0f} s", flush=True)
    by_kind = {item.kind: item for item in dataset.indenters}
    other = replace(dataset, indenters=(by_kind.pop(HELD_OUT_INDENTER),))
    known = replace(dataset, indenters=tuple(by_kind.values()))
    tests = {
        "held-out samples": known,
        f"held-out object ({HELD_OUT_INDENTER})": other,
        "held-out light": replace(known, camera=OTHER_LIGHT),
        "held-out sensors": replace(known, variants=4, errors=load_recipe("objects").errors),
    }
    print(f"{'RMS error':<20}frames", *COLUMNS, sep="  ")
    for title, recipe in tests.items():
        frames = tests_of(recipe, dataset.samples, count)
        true = np.array([item.wrench for item in frames])
        found, usable = measured(folder / "sensor.yaml", frames)
        print(title)
        print_errors("the force itself", true)
        print_errors("network", np.array([network.wrench(item) for item in frames]) - true)
        print_errors("pipeline", found - true)
        print_errors("where usable", (found - true)[usable])


if __name__ == "__main__":
    try:
        main(Path((sys.argv[1:] or ["presses"])[0]), *map(int, sys.argv[2:]))
    except CmpTactileError as error:
        sys.exit(f"error: {error}")
