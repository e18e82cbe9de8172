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

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tables import head, line

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
from cmp_tactile_simulation.scenes.description import Hold, MoveBy, Phase, Start, Touch
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.scenes.simulation import Simulation

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


def changed(sensor: SensorDescription, part: str, **values: object) -> SensorDescription:
    """With other values in one part, "camera" or "pattern.surface"."""
    first, _, rest = part.partition(".")
    if rest:
        inner = changed(getattr(sensor, first), rest, **values)  # type: ignore[arg-type]
        return replace(sensor, **{first: inner})
    return replace(sensor, **{first: replace(getattr(sensor, first), **values)})


def scaled(part: str, *keys: str) -> Change:
    """Values of a part by a relative error."""

    def change(sensor: SensorDescription, error: float) -> SensorDescription:
        owner = sensor
        for name in part.split("."):
            owner = getattr(owner, name)
        return changed(sensor, part, **{key: getattr(owner, key) * (1 + error) for key in keys})

    return change


def with_size(axis: int) -> Change:
    """A side of the gel."""

    def change(sensor: SensorDescription, error: float) -> SensorDescription:
        size = list(sensor.elastomer.size)
        size[axis] *= 1 + error
        return changed(sensor, "elastomer", size=tuple(size))

    return change


def with_young(sensor: SensorDescription, error: float) -> SensorDescription:
    """The modulus of gel and skin."""
    sensor = scaled("elastomer", "young")(sensor, error)
    return scaled("elastomer.shading_layer", "young")(sensor, error)


def with_poisson(sensor: SensorDescription, error: float) -> SensorDescription:
    """Poisson's ratio, below 0.5."""
    poisson = min(sensor.elastomer.poisson * (1 + error), 0.4995)
    return changed(sensor, "elastomer", poisson=poisson)


def with_centre(key: str) -> Change:
    """The principal point, by a share of half the frame."""

    def change(sensor: SensorDescription, error: float) -> SensorDescription:
        half = sensor.image.width / 2 if key == "cx" else sensor.image.height / 2
        return changed(sensor, "camera", **{key: getattr(sensor.camera, key) + error * half})

    return change


def with_distortion(number: int) -> Change:
    """A coefficient of the lens."""

    def change(sensor: SensorDescription, error: float) -> SensorDescription:
        values = list(sensor.camera.distortion)
        values[number] += error
        return changed(sensor, "camera", distortion=tuple(values))

    return change


def with_pose(axis: int, *, turned: bool) -> Change:
    """The gel, turned in rad or shifted by shares of RIG_M."""

    def change(sensor: SensorDescription, error: float) -> SensorDescription:
        pose = sensor.optics.T_camera_gel.copy()
        step = np.eye(3)[axis] * error
        if turned:
            pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(step).as_matrix()
        else:
            pose[:3, 3] += pose[:3, :3] @ (RIG_M * step)
        return changed(sensor, "optics", T_camera_gel=pose)

    return change


def with_mirror(*, tilted: bool) -> Change:
    """The left mirror."""

    def change(sensor: SensorDescription, error: float) -> SensorDescription:
        mirror = sensor.views["left"].mirror
        if tilted:
            normal = mirror.normal + np.array([error, 0.0, 0.0])
            mirror = replace(mirror, normal=normal / np.linalg.norm(normal))
        else:
            mirror = replace(mirror, distance=mirror.distance * (1 + error))
        views = dict(sensor.views)
        views["left"] = replace(views["left"], mirror=mirror)
        return replace(sensor, views=views)

    return change


def with_index(sensor: SensorDescription, error: float) -> SensorDescription:
    """The index of the last layer, or one that is not there."""
    base = sensor.elastomer.shading_layer.thickness - sensor.elastomer.size[2]
    layers = sensor.optics.layers or (RefractingLayer(base, 1.0),)
    last = replace(layers[-1], index=max(layers[-1].index * (1 + error), 1.0))
    return changed(sensor, "optics", layers=(*layers[:-1], last))


def thin(sensor: SensorDescription) -> SensorDescription:
    """Flat, with half the gel, which hardly changes its volume."""
    sensor = changed(sensor, "pattern", surface=PatternSurface("plane"))
    width, length, thickness = sensor.elastomer.size
    return changed(sensor, "elastomer", size=(width, length, thickness / 2), poisson=0.495)


CHANGES: dict[str, Change] = {
    "focal length": scaled("camera", "fx", "fy"),
    "fx alone": scaled("camera", "fx"),
    "cx": with_centre("cx"),
    "cy": with_centre("cy"),
    "k1": with_distortion(0),
    "k2": with_distortion(1),
    **{f"gel turned about {axis}": with_pose(k, turned=True) for k, axis in enumerate("xyz")},
    **{f"gel shifted along {axis}": with_pose(k, turned=False) for k, axis in enumerate("xyz")},
    "mirror distance": with_mirror(tilted=False),
    "mirror tilt": with_mirror(tilted=True),
    "index": with_index,
    "pitch": scaled("pattern", "pitch"),
    "surface radius": scaled("pattern.surface", "radius"),
    "young": with_young,
    "poisson": with_poisson,
    "size x": with_size(0),
    "thickness": with_size(2),
    "skin thickness": scaled("elastomer.shading_layer", "thickness"),
    "skin young": scaled("elastomer.shading_layer", "young"),
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


def rendered(sensor: SensorDescription) -> tuple[list[NDArray[np.uint8]], Array]:
    """Frames of a ball that presses, the first REST_FRAMES of them at rest, and forces (n, 3)."""
    scene = load_scene("contact_sphere")
    depth = 0.06 * sensor.elastomer.size[2]
    motion = (
        Phase("rest", REST_FRAMES, Hold()),
        Phase("close", 6, MoveBy((0.0, 0.0, -depth - CLEARANCE_M))),
        Phase("drag", 3, MoveBy((2e-4, 1e-4, 0.0))),
    )
    start = Start(Touch((5e-4, -3e-4), CLEARANCE_M))
    frames = Simulation(replace(scene, sensor=sensor, start=start, motion=motion)).frames()
    images, forces = zip(*((f.image, f.force.wrench[:3]) for f in frames), strict=True)
    return list(images), np.stack(forces)


def rendered_rows() -> Iterator[str]:
    """A row for each fault: the last frame."""
    rig = load_sensor("sample_rig")
    plain, glass = rendered(rig), rendered(with_index(rig, 0.45))
    flat = changed(rig, "pattern", surface=PatternSurface("plane"))
    cases: list[tuple[str, SensorDescription, tuple[list[NDArray[np.uint8]], Array]]] = [
        ("nothing", rig, plain),
        ("layer of glass not described", rig, glass),
        ("flat described for a cap", flat, plain),
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
    name: str,
    described: SensorDescription,
    rest: list[NDArray[np.uint8]],
    images: list[NDArray[np.uint8]],
    forces: Array,
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
    pose = sensor.optics.T_camera_gel.copy()
    pose[:3, 3] *= 10
    sensor = changed(sensor, "optics", T_camera_gel=pose)
    sensor = changed(sensor, "pattern", pitch=10 * sensor.pattern.pitch)
    sensor = CHANGES["surface radius"](sensor, 9.0)
    size = tuple(10 * side for side in sensor.elastomer.size)
    sensor = changed(sensor, "elastomer", size=size)
    views = {
        name: replace(view, mirror=replace(view.mirror, distance=10 * view.mirror.distance))
        for name, view in sensor.views.items()
    }
    return replace(CHANGES["skin thickness"](sensor, 9.0), views=views)


def assumed_young(sensor: SensorDescription) -> SensorDescription:
    """A modulus that nobody measured and that is 38 % too large, as of `cmp_tactile init`."""
    known = Uncertainty({"elastomer.young": 0.5}, assumed=("elastomer.young",))
    return replace(with_young(sensor, 0.38), uncertainty=known)


def main() -> None:
    """Print what the options ask for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", action="store_true", help="rendered presses, one fault each")
    parser.add_argument("--count", type=int, default=0, help="descriptions with a random error")
    options = parser.parse_args()
    for text in rendered_rows() if options.rows else ():
        print(text, flush=True)
    for text in random_rows(options.count) if options.count else ():
        print(text, flush=True)


if __name__ == "__main__":
    main()
