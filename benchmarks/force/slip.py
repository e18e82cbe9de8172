#!/usr/bin/env python3
"""Compare the slip and friction that SlipObserver reports with those of simulated contacts.

Balls and other bodies are pressed, dragged, twisted and rolled on the gel of the sample rig, with
Coulomb friction. Noise is added to the displacements of the markers. The truth is the state of the
contact solver's nodes. `--noise` scales the noise of 2 um in plane and 5 um in depth.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter

sys.path.insert(0, str(Path(__file__).parents[1]))
import numpy as np
from errors import NOISE_M, surface_of
from numpy.typing import NDArray
from tables import CommandLine, head, line

from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.measured import SlipEstimate, SlipState
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.slip.observer import SlipObserver
from cmp_tactile_simulation.gel import LinearElastomer
from cmp_tactile_simulation.indenter_shapes import Cuboid, Cylinder, Sphere
from hard_frames.contacts import Frame, Trial, at_markers

COLUMNS = (
    "contact", "friction", "reported from slip ratio", "full, frames late", "false", "early",
    "unknown", "friction, full", "foreseen", "largest error of the traction ratio",
)  # fmt: skip
MOVING = (SlipState.INCIPIENT, SlipState.FULL)


def drag(
    gel: LinearElastomer, radius: float, normal: float, friction: float, angle: float
) -> Trial:
    """Press, hold, drag until it slides and farther, hold, drag back."""
    way = np.array([np.cos(angle), np.sin(angle), 0.0])
    trial = Trial(gel, Sphere(radius), friction, tuple(-8e-4 * way[:2]))
    # Hertz on a half-space moves by 3 mu F / (16 a G) until it slides; a thin gel by less.
    contact = (0.75 * normal * radius * 0.77 / 0.65e6) ** (1 / 3)
    far = 2.4 * friction * normal / (contact * 1.7e5) * 0.16 + 3e-4
    trial.press(normal, 15).hold(6).move(tuple(far * way), 40).hold(6)
    return trial.move(tuple(-0.6 * far * way), 25)


CASES: dict[str, Callable[[LinearElastomer], Trial]] = {
    "ball 8 mm, 1 N": lambda gel: drag(gel, 8e-3, 1.0, 0.5, 0.8),
    "ball 8 mm, 3 N": lambda gel: drag(gel, 8e-3, 3.0, 0.5, 0.0),
    "ball 8 mm, 3 N, slippery": lambda gel: drag(gel, 8e-3, 3.0, 0.3, -0.8),
    "ball 8 mm, 8 N": lambda gel: drag(gel, 8e-3, 8.0, 0.6, 0.0),
    "ball 8 mm, 10 N, slippery": lambda gel: drag(gel, 8e-3, 10.0, 0.3, 1.6),
    "ball 4 mm, 3 N": lambda gel: drag(gel, 4e-3, 3.0, 0.6, -1.6),
    "ball 6 mm, 2 N, rough": lambda gel: drag(gel, 6e-3, 2.0, 0.9, 0.0),
    "ball 15 mm, 5 N, rough": lambda gel: drag(gel, 15e-3, 5.0, 0.9, 3.1),
    "ball, twisted": lambda gel: (
        Trial(gel, Sphere(8e-3), 0.5, (0, 0))
        .press(4.0, 15)
        .move((0, 0, 0), 40, (0, 0, 0.8))
        .hold(6)
    ),
    "ball, twisted and dragged": lambda gel: (
        Trial(gel, Sphere(8e-3), 0.5, (-5e-4, 0))
        .press(4.0, 15)
        .move((1.2e-3, 0, 0), 40, (0, 0, 0.4))
        .hold(6)
    ),
    "ball, pressed less and less": lambda gel: (
        Trial(gel, Sphere(8e-3), 0.5, (-1e-3, 0))
        .press(5.0, 10)
        .press(5.0, 15, (1.0, 0))
        .press(2.15, 25, (1.0, 0))
        .move((6e-4, 0, 0), 14)
    ),
    "ball, obliquely, then more": lambda gel: (
        Trial(gel, Sphere(8e-3), 0.6, (0, 0))
        .press(0.1, 2)
        .press(6.0, 40, (1.8, 0))
        .press(6.0, 20, (3.3, 0))
    ),
    "ball, press and hold": lambda gel: (
        Trial(gel, Sphere(8e-3), 0.9, (7e-4, -4e-4)).press(8.0, 40).hold(20).press(0.3, 30)
    ),
    "rod, rolled": lambda gel: (
        Trial(gel, Cylinder(5e-3, 8e-3, 1e-3), 0.8, (0, -2e-3))
        .move((0, 0, -5e-4), 12)
        .move((0, 3e-3, 0), 40, (-0.6, 0, 0))
    ),
    "box on its face": lambda gel: (
        Trial(gel, Cuboid((6e-3, 6e-3, 4e-3), 5e-4), 0.5, (-5e-4, 0))
        .press(5.0, 12)
        .move((1.5e-3, 0, 0), 40)
        .hold(6)
    ),
}


class Observer:
    """ForceModel and SlipObserver on noisy markers."""

    def __init__(self, sensor: SensorDescription, gel: LinearElastomer, noise: float) -> None:
        self._sensor, self._seen, self._noise = sensor, gel.observers, noise * NOISE_M
        self._model = ForceModel(sensor)
        self.durations: list[float] = []

    def data(self, frames: list[Frame], seed: int) -> Iterator[SlipEstimate]:
        """What is reported of the frames."""
        rng, slip = np.random.default_rng(seed), SlipObserver(self._sensor)
        for frame in frames:
            moved = at_markers(self._seen, self._model.elastic.markers, frame.moved)
            moved += rng.normal(size=moved.shape) * self._noise
            surface = surface_of(self._sensor, moved)
            field = self._model.reconstruct_random(surface.displacement, surface.status)
            start = perf_counter()
            data = slip.update(field, surface)
            self.durations.append(perf_counter() - start)
            yield data.slip


def row(name: str, trial: Trial, data: list[SlipEstimate]) -> str:
    """A line of the table."""
    mu, frames = trial.friction, trial.frames
    true = [frame.truth for frame in frames]
    first = next((t for t, e in zip(true, data, strict=True) if e.state in MOVING), None)
    begins = [
        next((k for k, e in enumerate(each) if e.state is SlipState.FULL), None)
        for each in (true, data)
    ]
    delay = "-" if None in begins else f"{begins[1] - begins[0]:+d}"  # type: ignore[operator]
    pairs = [(t, e) for t, e in zip(true, data, strict=True) if t.state > SlipState.NO_CONTACT]
    false = sum(e.state in MOVING and t.slip_ratio < 0.05 for t, e in pairs)
    still = sum(t.slip_ratio < 0.05 for t, _ in pairs)
    early = sum(e.state is SlipState.FULL and t.slip_ratio < 0.85 for t, e in pairs)
    unknown = sum(e.state is SlipState.UNKNOWN for _, e in pairs)
    full = np.array([e.friction_coefficient for e in data if e.state is SlipState.FULL])
    part = np.array([e.friction_coefficient for e in data if e.state is SlipState.INCIPIENT])
    part = part[np.isfinite(part)]
    ratio = [abs(e.traction_ratio - t.traction_ratio) for t, e in pairs]
    begin = "-" if first is None else f"{first.slip_ratio:.2f}"
    return line(
        name, f"{mu:g}", begin, delay, f"{false}/{still}", early, f"{unknown}/{len(pairs)}",
        _percent(full, mu), _percent(part, mu), f"{np.nanmax(ratio):.3f}",
    )  # fmt: skip


def _percent(values: NDArray[np.float64], mu: float) -> str:
    return "-" if len(values) == 0 else f"{100 * (values.mean() / mu - 1):+.1f} %"


def main() -> None:
    """Measure and print the table."""
    parser = CommandLine(__doc__)
    parser.option("--noise", "factor of the noise", 1.0)
    parser.option("--nodes", "contact nodes along a side", 40)
    parser.option("--only", "measure only cases with this text in their name", "")
    arguments = parser.parse_args()
    sensor = load_sensor("sample_rig")
    gel = LinearElastomer(sensor, arguments.nodes)
    observer = Observer(sensor, gel, arguments.noise)
    print(head(*COLUMNS))
    for name, make in CASES.items():
        if arguments.only in name:
            trial = make(gel)
            print(row(name, trial, list(observer.data(trial.frames, seed=1))), flush=True)
    durations = 1e3 * np.array(observer.durations)
    print(f"\ntime of a frame: {np.percentile(durations, 25):.2f} ms (lower quartile)")


if __name__ == "__main__":
    main()
