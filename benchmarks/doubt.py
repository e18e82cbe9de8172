#!/usr/bin/env python3
"""Does the error bar of a force contain what is wrong with the description?

    setup/run python3 benchmarks/doubt.py --rows           # rendered presses, one fault each
    setup/run python3 benchmarks/doubt.py --count 200      # descriptions with one random error each

Row: a press of known force is rendered with the true description and processed with the wrong one,
after a reference from frames at rest.  `--count`: each description differs from the true one in one
key, by 0.2 to 5 % (of rad, or of 30 mm, where the key has no size of its own).  Pixels of the
markers are projected and get noise; then all runs as in `cmp_tactile process`.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tables import CommandLine, head, line

from cmp_tactile_processing.elastic.model import ElasticModel
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.force.advice import UNUSABLE, flag_names
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import ForceField, Grid
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import PatternSurface, RefractingLayer, Uncertainty
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.surface.gauge import RestGauge
from cmp_tactile_processing.surface.reference_keeping import ReferenceKeeper
from cmp_tactile_simulation.scenes.description import Hold, MoveBy, Phase, Touch
from hard_frames.contacts import frames_of_ball

Image = NDArray[np.uint8]

Array = NDArray[np.float64]
Change = Callable[[SensorDescription, float], SensorDescription]

# Deviations beyond which an error was not contained.
BEYOND = 4.0
# Noise of corners, px; frames of a reference.
NOISE_PX, REFERENCE_FRAMES = 0.01, 10
# Of a key without a size of its own: a rig's size, m.
RIG_M = 0.03
# Of rendered presses.
REST_FRAMES, CLEARANCE_M = 4, 0.2e-3
ROWS = (
    ("focal length", -0.012), ("focal length", 0.003), ("focal length", 0.03),
    ("focal length", 0.05), ("pitch", 0.03), ("pitch", -0.024), ("cx", 0.02), ("young", 0.05),
)  # fmt: skip
# Balls: middle x and y, radius of the contact, m; force, N.
PRESSES = (
    (0.5e-3, -0.3e-3, 1.5e-3, (0.0, 0.0, -2.2)),
    (0.0, 0.0, 4e-3, (0.0, 0.0, -8.0)),
    (1e-3, 1e-3, 0.8e-3, (0.0, 0.0, -0.6)),
    (-0.5e-3, 0.4e-3, 2e-3, (0.9, -0.4, -3.0)),
    (4e-3, 2e-3, 1.5e-3, (0.3, 0.2, -2.0)),
)


def changed(owner: Any, path: str, change: Callable[[Any], Any]) -> Any:
    """With the value at a path changed: "camera.fx", "elastomer.size.0", "views.left"."""
    name, _, rest = path.partition(".")
    if not name:
        return change(owner)
    if isinstance(owner, tuple):
        number = int(name)
        new = changed(owner[number], rest, change)
        return (*owner[:number], new, *owner[number + 1 :])
    if isinstance(owner, dict):
        return owner | {name: changed(owner[name], rest, change)}
    return replace(owner, **{name: changed(getattr(owner, name), rest, change)})


def with_value(path: str, change: Callable[[Any, float], Any]) -> Change:
    """A value changed by an error."""
    return lambda sensor, error: changed(sensor, path, lambda value: change(value, error))


def scaled(*paths: str) -> Change:
    """Values by a relative error."""

    def change(sensor: SensorDescription, error: float) -> SensorDescription:
        for path in paths:
            sensor = changed(sensor, path, lambda value: value * (1 + error))
        return sensor

    return change


def with_centre(key: str, side: str) -> Change:
    """The principal point, by a share of half the frame."""
    return lambda sensor, error: changed(
        sensor, f"camera.{key}", lambda value: value + error * getattr(sensor.image, side) / 2
    )


def with_pose(axis: int, *, turned: bool) -> Change:
    """The gel, turned in rad or shifted by shares of RIG_M."""
    step = np.eye(3)[axis]

    def move(pose: Array, error: float) -> Array:
        moved = np.eye(4)
        if turned:
            moved[:3, :3] = Rotation.from_rotvec(error * step).as_matrix()
        else:
            moved[:3, 3] = RIG_M * error * step
        return pose @ moved

    return with_value("optics.T_camera_gel", move)


def tilted(normal: Array, error: float) -> Array:
    """The normal of a mirror."""
    normal = normal + np.array([error, 0.0, 0.0])
    return np.asarray(normal / np.linalg.norm(normal))


def with_index(sensor: SensorDescription, error: float) -> SensorDescription:
    """The index of the last layer, or one that is not there."""
    base = sensor.elastomer.shading_layer.thickness - sensor.elastomer.size[2]
    layers = sensor.optics.layers or (RefractingLayer(base, 1.0),)
    last = replace(layers[-1], index=max(layers[-1].index * (1 + error), 1.0))
    return replace(sensor, optics=replace(sensor.optics, layers=(*layers[:-1], last)))


def flat(sensor: SensorDescription) -> SensorDescription:
    """With a flat surface."""
    return replace(sensor, pattern=replace(sensor.pattern, surface=PatternSurface("plane")))


def thin(sensor: SensorDescription) -> SensorDescription:
    """Flat, with half the gel, which hardly changes its volume."""
    sensor = scaled("elastomer.size.2")(flat(sensor), -0.5)
    return replace(sensor, elastomer=replace(sensor.elastomer, poisson=0.495))


CHANGES: dict[str, Change] = {
    "focal length": scaled("camera.fx", "camera.fy"),
    "fx alone": scaled("camera.fx"),
    "cx": with_centre("cx", "width"),
    "cy": with_centre("cy", "height"),
    "k1": with_value("camera.distortion.0", operator.add),
    "k2": with_value("camera.distortion.1", operator.add),
    **{f"gel turned about {axis}": with_pose(k, turned=True) for k, axis in enumerate("xyz")},
    **{f"gel shifted along {axis}": with_pose(k, turned=False) for k, axis in enumerate("xyz")},
    "mirror distance": scaled("views.left.mirror.distance"),
    "mirror tilt": with_value("views.left.mirror.normal", tilted),
    "index": with_index,
    "pitch": scaled("pattern.pitch"),
    "surface radius": scaled("pattern.surface.radius"),
    "young": scaled("elastomer.young", "elastomer.shading_layer.young"),
    "poisson": with_value("elastomer.poisson", lambda nu, error: min(nu * (1 + error), 0.4995)),
    "size x": scaled("elastomer.size.0"),
    "thickness": scaled("elastomer.size.2"),
    "skin thickness": scaled("elastomer.shading_layer.thickness"),
    "skin young": scaled("elastomer.shading_layer.young"),
}


@dataclass(frozen=True)
class Known:
    """A true sensor: where markers move under the presses, and with which force."""

    sensor: SensorDescription
    forces: Array
    moved: Array

    @classmethod
    def pressed(cls, sensor: SensorDescription) -> Known:
        """Under PRESSES, by the elastic model itself."""
        model = ElasticModel(sensor)
        place = model.node_position[:, :2]
        forces, moved = [], []
        for x, y, radius, force in PRESSES:
            pressure = 1 - ((place - [x, y]) ** 2).sum(axis=1) / radius**2
            share = np.sqrt(np.maximum(pressure, 0.0))
            forces.append(np.array(force))
            moved.append(model.displacement((share / share.sum())[:, None] * forces[-1]))
        return cls(sensor, np.stack(forces), np.stack(moved))

    def grids(self, moved: Array, random: np.random.Generator, std: float) -> dict[str, Grid]:
        """What the views show of markers that have moved, (rows, cols, 3) m."""
        shape = self.sensor.pattern.shape
        found = {}
        for name, view in build_views(self.sensor).items():
            pixels = view.project(self.sensor.pattern.corners() + moved)
            pixels = pixels + random.normal(0, std, pixels.shape)
            found[name] = replace(
                Grid.missing(shape, ""),
                corners=pixels,
                corner_status=np.ones(shape.corners, np.uint8),
                corner_std=np.full(shape.corners, NOISE_PX),
            )
        return found

    def felt_by(
        self, described: SensorDescription, random: np.random.Generator
    ) -> tuple[str, list[ForceField]]:
        """What a description makes of these presses: of the reference, and the forces."""
        rig, stage = StereoRig(described), ForceStage(described)
        keeper = ReferenceKeeper(Reference.nominal(described), RestGauge(described))
        nothing = np.zeros_like(self.moved[0])
        rest = self.grids(nothing, random, NOISE_PX / np.sqrt(REFERENCE_FRAMES))
        said = keeper.take([rig.triangulate(rest.get("left"), rest.get("right"))], 1)
        fields = []
        for moved in self.moved:
            seen = self.grids(moved, random, NOISE_PX)
            markers = rig.triangulate(seen.get("left"), seen.get("right"))
            fields.append(stage.process(keeper.reference.surface(markers)))
        return said, fields


@dataclass(frozen=True)
class Felt:
    """Of a frame: largest error of a component over its deviation, and of the force, relative."""

    deviations: float
    share: float
    usable: bool

    @classmethod
    def from_field(cls, field: ForceField, force: Array) -> Felt:
        """force (3,) N: the true one."""
        off = field.wrench[:3] - force
        deviations = float(np.abs(off / field.wrench_std[:3]).max())
        share = float(np.linalg.norm(off) / np.linalg.norm(force))
        return cls(deviations, share, not field.flags & UNUSABLE)


def random_rows(count: int) -> Iterator[str]:
    """A row for each key, and one for all."""
    random = np.random.default_rng(17)
    truths = load_sensor("sample_rig"), load_sensor("prototype"), thin(load_sensor("sample_rig"))
    known = [Known.pressed(sensor) for sensor in truths]
    names = list(CHANGES)
    found: dict[str, list[Felt]] = {name: [] for name in names}
    refused = 0
    for number in range(count):
        name, truth = names[number % len(names)], known[number // len(names) % len(known)]
        error = float(np.exp(random.uniform(np.log(0.002), np.log(0.05)))) * random.choice([-1, 1])
        try:
            _, fields = truth.felt_by(CHANGES[name](truth.sensor, error), random)
        except CmpTactileError:
            refused += 1
            continue
        pairs = zip(fields, truth.forces, strict=True)
        found[name] += [Felt.from_field(field, force) for field, force in pairs]
    yield head("key", "frames", "usable", "their largest error", "in deviations",
               "beyond 4", "largest error of the others")  # fmt: skip
    for name, frames in found.items():
        yield _row(name, frames)
    yield _row(
        f"all ({refused} descriptions refused)", [f for part in found.values() for f in part]
    )


def _row(name: str, frames: list[Felt]) -> str:
    good, others = ([f for f in frames if f.usable == usable] for usable in (True, False))
    largest = f"{max((f.share for f in good), default=0.0):.1%}"
    deviations = max((f.deviations for f in good), default=0.0)
    # NaN counts as beyond.
    beyond = sum(not f.deviations <= BEYOND for f in good)
    rest = f"{max((f.share for f in others), default=0.0):.1%}"
    return line(name, len(frames), len(good), largest, f"{deviations:.2f}", beyond, rest)


def rendered(sensor: SensorDescription) -> tuple[list[Image], Array]:
    """Frames of a ball that presses, the first REST_FRAMES of them at rest, and forces (n, 3)."""
    depth = 0.06 * sensor.elastomer.size[2]
    return frames_of_ball(
        sensor,
        Touch((5e-4, -3e-4), CLEARANCE_M),
        Phase("rest", REST_FRAMES, Hold()),
        Phase("close", 6, MoveBy((0.0, 0.0, -depth - CLEARANCE_M))),
        Phase("drag", 3, MoveBy((2e-4, 1e-4, 0.0))),
    )


def rendered_rows() -> Iterator[str]:
    """A row for each fault: the last frame."""
    rig = load_sensor("sample_rig")
    plain, glass = rendered(rig), rendered(with_index(rig, 0.45))
    cases: list[tuple[str, SensorDescription, tuple[list[Image], Array]]] = [
        ("nothing", rig, plain),
        ("layer of glass not described", rig, glass),
        ("flat described for a cap", flat(rig), plain),
        ("diameter for radius", CHANGES["surface radius"](rig, 1.0), plain),
        ("all lengths in cm", in_centimetres(rig), plain),
        ("modulus assumed", assumed_young(rig), plain),
    ]
    for name, error in ROWS:
        cases.append((f"{name} {error:+.1%}", CHANGES[name](rig, error), plain))
    yield head("fault", "Fz, N", "std, N", "true, N", "error in deviations", "usable", "flags")
    for name, described, (images, forces) in cases:
        yield _rendered_row(name, described, images[:REST_FRAMES], images, forces)
    loaded = images[-1:] * REST_FRAMES
    yield _rendered_row("reference under this load", rig, loaded, plain[0], plain[1])


def _rendered_row(
    name: str, described: SensorDescription, rest: list[Image], images: list[Image], forces: Array
) -> str:
    try:
        pipeline = Pipeline(described)
        pipeline.set_reference(rest)
        field = [pipeline.process(image).force for image in images][-1]
    except CmpTactileError as error:
        return line(name, f"refused: {error}", "", "", "", "", "")
    felt = Felt.from_field(field, forces[-1])
    wrench, std = field.wrench[2], field.wrench_std[2]
    return line(
        name, f"{wrench:.2f}", f"{std:.2f}", f"{forces[-1][2]:.2f}", f"{felt.deviations:.1f}",
        "yes" if felt.usable else "no", flag_names(field.flags),
    )  # fmt: skip


def in_centimetres(sensor: SensorDescription) -> SensorDescription:
    """All lengths ten times as large: the images are the same."""
    paths = [f"elastomer.size.{axis}" for axis in range(3)]
    paths += [f"views.{name}.mirror.distance" for name in sensor.views]
    paths += ["pattern.pitch", "pattern.surface.radius", "elastomer.shading_layer.thickness"]
    away = np.array([[1, 1, 1, 10], [1, 1, 1, 10], [1, 1, 1, 10], [1, 1, 1, 1]])
    sensor = changed(sensor, "optics.T_camera_gel", lambda pose: pose * away)
    return scaled(*paths)(sensor, 9.0)


def assumed_young(sensor: SensorDescription) -> SensorDescription:
    """A modulus that nobody measured and that is 38 % too large, as of `cmp_tactile init`."""
    known = Uncertainty({"elastomer.young": 0.5}, assumed=("elastomer.young",))
    return replace(CHANGES["young"](sensor, 0.38), uncertainty=known)


def main() -> None:
    """Print what the options ask for."""
    parser = CommandLine(__doc__)
    parser.option("--rows", "rendered presses, one fault each", False)
    parser.option("--count", "descriptions with a random error", 0)
    options = parser.parse_args()
    for text in rendered_rows() if options.rows else ():
        print(text, flush=True)
    for text in random_rows(options.count) if options.count else ():
        print(text, flush=True)


if __name__ == "__main__":
    main()
