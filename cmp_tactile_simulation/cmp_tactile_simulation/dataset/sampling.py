"""Draws and simulates the samples of a recipe: number k follows from the recipe and k alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from cmp_tactile_processing.processes import OnProgress
from cmp_tactile_processing.sensor.description import SensorDescription, sensor_description_of
from cmp_tactile_processing.sensor.yaml_file import YamlFile
from cmp_tactile_simulation.dataset.distribution import Distribution
from cmp_tactile_simulation.dataset.recipe import IndenterKeys, Recipe, with_errors
from cmp_tactile_simulation.indenters import Indenter, MeshIndenter
from cmp_tactile_simulation.rendering import Purpose, random_stream
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.ink import PrintDefects
from cmp_tactile_simulation.scenes.description import INDENTERS, MAX_SEED
from cmp_tactile_simulation.simulator import Look, SimulatedFrame, Simulator, turned

# Meshes that are kept as height fields.
MESHES_KEPT = 32


@dataclass(frozen=True)
class Sample:
    """What was drawn for a sample.

    indenter: name of the shape or file, values: of its lengths, m, or of a mesh's scale.
    place (x, y), depth, shear (x, y): m.  look: with a seed of its own.
    """

    number: int
    variant: int
    indenter: str
    values: Mapping[str, Any]
    mesh: Path | None
    friction: float
    place: tuple[float, float]
    rotation_deg: tuple[float, float, float]
    depth: float
    shear: tuple[float, float]
    twist_deg: float
    look: Look

    def body(self) -> Indenter:
        """The indenter; InputError where it cannot be made of these values."""
        if self.mesh is not None:
            return _mesh(self.mesh, self.rotation_deg, **self.values)
        body: Indenter = INDENTERS[self.indenter](**self.values)
        return body


@lru_cache(MESHES_KEPT)
def _mesh(path: Path, rotation_deg: tuple[float, float, float], **values: float) -> MeshIndenter:
    return MeshIndenter.load(path, **values, rotation=turned(rotation_deg))


def draw(recipe: Recipe, number: int) -> Sample:
    """Sample number `number` of a recipe."""
    rng = random_stream(Purpose.SAMPLE, recipe.seed, number)
    weights = np.array([item.weight for item in recipe.indenters])
    keys = recipe.indenters[rng.choice(len(weights), p=weights / weights.sum())]
    mesh = keys.meshes[rng.integers(len(keys.meshes))] if keys.meshes else None
    values = {name: _drawn(item, rng) for name, item in keys.values.items()}
    x, y = (item.draw(rng) for item in recipe.place)
    about_x, about_y, about_z = (item.draw(rng) for item in recipe.rotation_deg)
    friction, depth, way = (
        item.draw(rng) for item in (recipe.friction, recipe.depth, recipe.shear)
    )
    direction = math.radians(recipe.shear_deg.draw(rng))
    twist_deg = recipe.twist_deg.draw(rng)
    look = Look(
        camera=CameraSettings(**_drawn_keys(recipe.camera, CameraSettings, rng)),
        defects=PrintDefects(**_drawn_keys(recipe.print, PrintDefects, rng)),
        samples=recipe.pixel_samples,
        seed=int(rng.integers(MAX_SEED)),
    )
    return Sample(
        number=number,
        variant=number % recipe.variants,
        indenter=_name(keys, mesh),
        values=values,
        mesh=mesh,
        friction=friction,
        place=(x, y),
        rotation_deg=(about_x, about_y, about_z),
        depth=depth,
        shear=(way * math.cos(direction), way * math.sin(direction)),
        twist_deg=twist_deg,
        look=look,
    )


def _name(keys: IndenterKeys, mesh: Path | None) -> str:
    return keys.kind if mesh is None else mesh.name


def _drawn(item: Distribution | tuple[Distribution, ...], rng: np.random.Generator) -> Any:
    if isinstance(item, tuple):
        return tuple(part.draw(rng) for part in item)
    return item.draw(rng)


def _drawn_keys(keys: Any, kind: type[Any], rng: np.random.Generator) -> dict[str, Any]:
    """Values of the parameters that the recipe names, whole ones where the parameter is."""
    values: dict[str, Any] = {}
    for item in fields(kind):
        given: Distribution | None = getattr(keys, item.name)
        if given is not None:
            value = given.draw(rng)
            values[item.name] = round(value) if isinstance(item.default, int) else value
    return values


def variant_file(recipe: Recipe, variant: int) -> dict[str, Any]:
    """The content of a variant's sensor description."""
    rng = random_stream(Purpose.VARIANT, recipe.seed, variant)
    errors = {key: item.draw(rng) for key, item in recipe.errors.items()}
    return with_errors(recipe.sensor_file.content, errors)


def variant_sensor(recipe: Recipe, variant: int) -> SensorDescription:
    """The sensor of a variant; InputError where the errors make it one that cannot be."""
    content = variant_file(recipe, variant)
    file = recipe.sensor_file
    return sensor_description_of(YamlFile(file.path, content, file.lines))


class Sampler:
    """Simulates samples of a recipe; keeps the simulator of the variant that it used last."""

    def __init__(self, recipe: Recipe, progress: OnProgress | None = None) -> None:
        self._recipe, self._progress = recipe, progress
        self._variant = -1
        self._simulator: Simulator | None = None

    def frames(self, sample: Sample) -> list[SimulatedFrame]:
        """The frames of a sample; CmpTactileError where it cannot be simulated."""
        simulator = self.simulator(sample.variant)
        simulator.use(sample.body(), sample.friction, look=sample.look)
        found: list[SimulatedFrame] = []
        before = np.zeros(3)
        for phase in self._recipe.history:
            goal = np.array([phase.depth, phase.shear, phase.twist])
            for number in range(1, phase.frames + 1):
                if phase.lift is not None:
                    frame = simulator.release(phase.lift * number / phase.frames)
                else:
                    depth, shear, twist = before + (goal - before) * number / phase.frames
                    frame = simulator.press(
                        depth=depth * sample.depth,
                        at=sample.place,
                        rotation_deg=sample.rotation_deg,
                        shear=(shear * sample.shear[0], shear * sample.shear[1]),
                        twist_deg=twist * sample.twist_deg,
                    )
                found.append(replace(frame, phase=phase.name))
            before = np.zeros(3) if phase.lift is not None else goal
        return found

    def simulator(self, variant: int) -> Simulator:
        """That of a variant; its gel is built where it is not yet known."""
        if self._simulator is None or variant != self._variant:
            recipe = self._recipe
            self._simulator = Simulator(
                variant_sensor(recipe, variant),
                look=Look(samples=recipe.pixel_samples),
                contact_nodes=recipe.contact_nodes,
                rate=recipe.rate,
                progress=self._progress,
            )
            self._variant = variant
        return self._simulator


def described(sample: Sample) -> dict[str, Any]:
    """What was drawn, as plain values: one row of a table."""
    look = asdict(sample.look)
    row = {
        "sample": sample.number,
        "variant": sample.variant,
        "indenter": sample.indenter,
        "friction": sample.friction,
        "depth": sample.depth,
        "twist_deg": sample.twist_deg,
        "seed": look["seed"],
    }
    several = {
        "place": sample.place,
        "rotation_deg": sample.rotation_deg,
        "shear": sample.shear,
        **sample.values,
        **look["camera"],
        **look["defects"],
    }
    for key, value in several.items():
        if isinstance(value, tuple):
            row |= {f"{key}_{axis}": part for axis, part in zip("xyz", value, strict=False)}
        else:
            row[key] = value
    return row
