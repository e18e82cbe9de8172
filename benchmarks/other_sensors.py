#!/usr/bin/env python3
"""Whole chain on random sensors and contacts that no parameter was chosen for.

Number N gives the same sensor on each machine: image size, lens, mirrors, corners, surface, gel,
noise, blur, and a ball or bar that presses and drags. A row has the errors of all frames against
the truth, and `beyond`: how many of the forces are more than 4 standard deviations off while no
flag is set.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from tables import CommandLine, head, line

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.pipeline import Pipeline, PipelineResult
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import (
    Elastomer,
    ImageSize,
    Mirror,
    Pattern,
    PatternSurface,
    Roi,
    ShadingLayer,
)
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.scenes.description import (
    Hold,
    IndenterDescription,
    MoveBy,
    Phase,
    Release,
    Scene,
    Start,
    Touch,
)
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.scenes.simulation import Simulation
from cmp_tactile_simulation.simulator import SimulatedFrame

Array = NDArray[np.float64]

REST_FRAMES, CLEARANCE = 4, 0.2e-3
# A corner farther off than this has another corner's number or is no measurement, px.
WRONG_PX = 2.0
BEYOND = 4.0
COLUMNS = (
    "number", "sensor", "contact", "corners, px", "largest", "lost", "wrong", "displacement, um",
    "Fz, N", "of", "beyond", "flags",
)  # fmt: skip


def random_sensor(random: np.random.Generator) -> SensorDescription:
    """The sample rig, of which all that makers choose is another."""
    rig = load_sensor("sample_rig")
    scale = float(random.choice([0.6, 0.8, 1.0, 1.5, 2.0]))
    width, height = round(1024 * scale), round(768 * scale)
    camera, half = rig.camera, width // 2
    lens = (random.uniform(-0.25, 0.15), random.uniform(-0.05, 0.1), *random.normal(0, 1e-3, 2))
    middle = scale * np.array([camera.cx, camera.cy]) + random.normal(0, 3 * scale, 2)
    camera = replace(
        camera,
        fx=scale * camera.fx,
        fy=scale * camera.fy * random.uniform(0.995, 1.005),
        cx=float(middle[0]),
        cy=float(middle[1]),
        distortion=(*map(float, lens), 0.0),
    )
    views = {}
    for name, left in (("left", 0), ("right", half)):
        mirror = rig.views[name].mirror
        normal = mirror.normal + random.normal(0, 0.006, 3)
        mirror = Mirror(
            normal / np.linalg.norm(normal), mirror.distance * random.uniform(0.98, 1.02)
        )
        views[name] = replace(rig.views[name], roi=Roi(left, 0, half, height), mirror=mirror)
    return replace(
        rig,
        name="random",
        image=ImageSize(width, height),
        camera=camera,
        views=views,
        pattern=_pattern(random),
        elastomer=_gel(random),
    )


def _pattern(random: np.random.Generator) -> Pattern:
    rows = int(random.integers(6, 31))
    cols = int(np.clip(rows + random.integers(-4, 5), 6, 30))
    surface = PatternSurface("sphere_cap", float(random.uniform(0.026, 0.1)))
    return Pattern(
        rows,
        cols,
        0.0145 * float(random.uniform(0.85, 1.02)) / (max(rows, cols) + 1),
        str(random.choice(["dark", "light"])),
        int(random.integers(1, 12)),
        PatternSurface("plane") if random.random() < 0.3 else surface,
    )


def _gel(random: np.random.Generator) -> Elastomer:
    young = float(10 ** random.uniform(5, 6.3))
    skin = ShadingLayer(
        float(random.choice([0.0, 0.3e-3, 0.6e-3])), young * float(10 ** random.uniform(-0.7, 0.7))
    )
    sides = map(float, random.uniform(0.019, 0.026, 2))
    return Elastomer(
        (*sides, float(random.uniform(0.003, 0.01))),
        young,
        float(random.choice([0.4, 0.45, 0.48, 0.49])),
        str(random.choice(["linear", "linear", "neo_hookean"])),
        skin,
    )


def random_scene(random: np.random.Generator, sensor: SensorDescription) -> Scene:
    """A press of 4 to 14 % of the gel's thickness, a drag, and the way back."""
    depth = sensor.elastomer.size[2] * random.uniform(0.04, 0.14)
    drag = random.uniform(-0.4e-3, 0.4e-3, 2)
    camera = CameraSettings(
        read_noise=float(random.choice([0.5, 1.0, 2.0, 4.0])),
        blur=float(random.choice([0.4, 0.7, 1.0, 1.5])),
    )
    ball = {"radius": float(random.uniform(1e-3, 8e-3))}
    return replace(
        load_scene("contact_sphere"),
        name="random",
        sensor=sensor,
        camera=camera,
        indenter=IndenterDescription("sphere", float(random.uniform(0.3, 1.0)), ball),
        start=Start(Touch(tuple(random.uniform(-2e-3, 2e-3, 2)), CLEARANCE)),
        motion=(
            Phase("rest", REST_FRAMES, Hold()),
            Phase("close", 6, MoveBy((0.0, 0.0, -depth - CLEARANCE))),
            Phase("drag", 3, MoveBy((*drag, 0.0))),
            Phase("open", 3, Release(0.3e-3)),
        ),
    )


@dataclass(frozen=True)
class Errors:
    """Of one frame.  corners: px, NaN where lost.  displacement: m.  force (3,) N, std (3,)."""

    corners: Array
    displacement: Array
    force: Array
    std: Array
    flags: int

    @classmethod
    def of_frame(cls, found: PipelineResult, frame: SimulatedFrame, rest: Array) -> Errors:
        """rest (rows, cols, 3) m: true places of the markers at rest."""
        grids = {"left": found.left, "right": found.right}
        corners = [
            np.linalg.norm(grids[view].corners - true.corners, axis=-1)
            for view, true in frame.grids.items()
        ]
        moved = found.surface.displacement - (frame.surface.position - rest)
        return cls(
            np.concatenate(corners, axis=None),
            np.linalg.norm(moved, axis=-1),
            (found.force.wrench - frame.force.wrench)[:3],
            found.force.random_std[:3],
            int(found.force.flags),
        )


def measure(scene: Scene) -> Iterator[tuple[Errors, float]]:
    """Errors of each frame, and the true normal force, N."""
    frames = list(Simulation(scene).frames())
    pipeline = Pipeline(scene.sensor)
    pipeline.set_reference([frame.image for frame in frames[:REST_FRAMES]])
    for frame in frames:
        errors = Errors.of_frame(pipeline.process(frame.image), frame, frames[0].surface.position)
        yield errors, -float(frame.force.wrench[2])


def row(number: int) -> str:
    """That of a sensor in the table."""
    random = np.random.default_rng(number)
    sensor = random_sensor(random)
    scene = random_scene(random, sensor)
    pattern, gel = sensor.pattern, sensor.elastomer
    what = f"{sensor.image.width} px, {pattern.rows} x {pattern.cols}, {pattern.surface.type}"
    what += f", {1e3 * gel.size[2]:.1f} mm, {gel.model}, noise {scene.camera.read_noise:g}"
    ball = f"ball of {2e3 * scene.indenter.values['radius']:.1f} mm"
    try:
        errors, pressed = zip(*measure(scene), strict=True)
    except CmpTactileError as error:
        return line(str(number), what, ball, f"refused: {error}", *[""] * (len(COLUMNS) - 4))
    corners = np.stack([item.corners for item in errors])
    force, std = (np.stack([getattr(item, name) for item in errors]) for name in ("force", "std"))
    flags = np.array([item.flags for item in errors])
    beyond = (np.abs(force) > BEYOND * std).any(axis=1) & (flags == 0)
    moved = np.stack([item.displacement for item in errors])
    return line(
        str(number), what, ball,
        f"{_rms(corners):.4f}", f"{np.nanmax(corners):.2f}",
        str(int(np.isnan(corners).sum())), str(int((corners > WRONG_PX).sum())),
        f"{1e6 * _rms(moved):.2f}", f"{_rms(force[:, 2]):.4f}", f"{max(pressed):.2f}",
        f"{int(beyond.sum())} of {len(beyond)}", ", ".join(sorted({str(f) for f in flags if f})),
    )  # fmt: skip


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def main() -> None:
    """Measure the sensors that the options ask for."""
    parser = CommandLine(__doc__)
    parser.option("--first", "number of the first", 0)
    parser.option("--count", "how many", 10)
    options = parser.parse_args()
    print(head(*COLUMNS))
    for number in range(options.first, options.first + options.count):
        print(row(number), flush=True)


if __name__ == "__main__":
    main()
