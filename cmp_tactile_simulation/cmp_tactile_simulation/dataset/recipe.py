"""A recipe: from which sensor, indenters and distributions the samples of a dataset are drawn.

docs/datasets.md lists the keys of its file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, make_dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

from cmp_tactile_processing.cache.files import packaged_files
from cmp_tactile_processing.errors import InputError, RefusedValueError
from cmp_tactile_processing.sensor.description import (
    SensorDescription,
    find_sensor_description,
    sensor_description_of,
)
from cmp_tactile_processing.sensor.yaml_file import (
    NOTHING,
    Part,
    YamlFile,
    did_you_mean,
    file_schema,
    named_file,
    number,
    part_schema,
    positive,
    read_yaml,
    text,
)
from cmp_tactile_simulation.dataset.distribution import FIXED, Distribution, Within
from cmp_tactile_simulation.gel import NODES_RANGE
from cmp_tactile_simulation.indenters import MeshIndenter
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.ink import PrintDefects
from cmp_tactile_simulation.scenes import description
from cmp_tactile_simulation.scenes.description import MAX_SAMPLES, MAX_SEED
from cmp_tactile_simulation.simulator import DEFAULT_FRICTION, MAX_FRICTION

FORMAT_VERSION = 1
MAX_DATASET, MAX_VARIANTS, MAX_PHASE_FRAMES = 1_000_000, 1000, 1000
MAX_DEPTH_M, MAX_TURN_DEG = 5e-3, 180.0
MESH_SUFFIXES = (".stl", ".obj", ".ply", ".off", ".glb", ".gltf")
# Relative errors of a sensor beyond these are another sensor.
MAX_ERROR = 0.5
ZERO, ONE = Distribution(FIXED, (0.0,)), Distribution(FIXED, (1.0,))
USUAL_FRICTION = Distribution(FIXED, (DEFAULT_FRICTION,))
USUAL_DEPTH = Distribution(FIXED, (3e-4,))
SHAPES = tuple(kind for kind in description.INDENTERS if kind != "sphere_group")

Place = Annotated[Distribution, Within(-description.MAX_REACH_M, description.MAX_REACH_M, "m")]
Turn = Annotated[Distribution, Within(-MAX_TURN_DEG, MAX_TURN_DEG, "degrees")]
Way = Annotated[Distribution, Within(0.0, MAX_DEPTH_M, "m")]
Friction = Annotated[Distribution, Within(0.0, MAX_FRICTION)]
Error = Annotated[Distribution, Within(-MAX_ERROR, MAX_ERROR)]


@dataclass(frozen=True, kw_only=True)
class Phase(Part):
    """A part of a sample: frames in which the indenter goes on to shares of what was drawn.

    depth, shear, twist: shares.  lift: off the gel instead, by so much, m.
    """

    name: str = field(metadata=text())
    frames: int = field(default=1, metadata=number(1, MAX_PHASE_FRAMES))
    depth: float = field(default=1.0, metadata=number(0.0, 1.0))
    shear: float = field(default=0.0, metadata=number(0.0, 1.0))
    twist: float = field(default=0.0, metadata=number(0.0, 1.0))
    lift: float | None = field(default=None, metadata=number(0.0, description.MAX_REACH_M, "m"))


ONE_PRESS = (Phase(name="press", shear=1.0, twist=1.0),)


def _drawn_parameters(name: str, kind: type[Any]) -> Any:
    """The keys of parameters, each a number or a distribution within the parameter's range."""
    own: list[Any] = []
    for item in fields(kind):
        meta = item.metadata
        within = Within(meta["low"], meta["high"], meta["unit"])
        own.append((item.name, Annotated[Distribution | None, within], field(default=None)))
    return make_dataclass(name, own, bases=(Part,), frozen=True, kw_only=True)


CameraKeys: Any = _drawn_parameters("CameraKeys", CameraSettings)
PrintKeys: Any = _drawn_parameters("PrintKeys", PrintDefects)


@dataclass(frozen=True, kw_only=True)
class RecipeKeys(Part):
    """The keys of a recipe that its file holds as they are.

    samples: their number.  variants: of the sensor, which differ by `errors`; sample k is of
    variant k modulo their number.  place: (x, y) of the indenter's origin, m.  rotation_deg: about
    the gel's x, y, z axis.  depth: below the first touch, m.  shear: way along the gel, m, in the
    direction shear_deg from the x axis.  history: of each sample.
    errors: key path in the sensor description -> relative error.
    contact_nodes, pixel_samples, rate: as contact_nodes, samples, rate of a scene.
    """

    name: description.Name
    title: str = field(default="", metadata=text())
    samples: int = field(default=1000, metadata=number(1, MAX_DATASET))
    seed: int = field(default=0, metadata=number(0, MAX_SEED))
    variants: int = field(default=1, metadata=number(1, MAX_VARIANTS))
    errors: Mapping[str, Error] = field(default_factory=dict)
    friction: Friction = USUAL_FRICTION
    place: tuple[Place, Place] = (ZERO, ZERO)
    rotation_deg: tuple[Turn, Turn, Turn] = (ZERO, ZERO, ZERO)
    depth: Way = USUAL_DEPTH
    shear: Way = ZERO
    shear_deg: Turn = ZERO
    twist_deg: Turn = ZERO
    history: tuple[Phase, ...] = ONE_PRESS
    camera: CameraKeys = field(default_factory=CameraKeys)
    print: PrintKeys = field(default_factory=PrintKeys)
    contact_nodes: int = field(default=32, metadata=number(*NODES_RANGE))
    pixel_samples: int = field(default=2, metadata=number(1, MAX_SAMPLES))
    rate: float = field(
        default=30.0, metadata=number(description.MIN_RATE_HZ, description.MAX_RATE_HZ)
    )

    def checked(self) -> RecipeKeys:
        """A sample has frames, and there are errors where there are variants."""
        if not self.history:
            raise RefusedValueError("a list of one or more phases", "history")
        if self.variants > 1 and not self.errors:
            raise RefusedValueError("relative errors, as there are variants", "errors")
        return self


@dataclass(frozen=True, kw_only=True)
class IndenterKeys:
    """Indenters of one kind.  values: of the shape, or scale and edge_radius of meshes.

    meshes: files, of which one is taken; empty for a shape.  weight: how often it is taken,
    relative to the others.
    """

    kind: str
    weight: float
    values: Mapping[str, Distribution | tuple[Distribution, ...]]
    meshes: tuple[Path, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Recipe(RecipeKeys):
    """All that a dataset depends on.

    sensor: as described.  sensor_file: what was read of it, of which variants are made.
    file: the recipe's own, as it was read.
    """

    sensor: SensorDescription
    sensor_file: YamlFile
    indenters: tuple[IndenterKeys, ...]
    file: YamlFile

    @property
    def frames(self) -> int:
        """Frames of a sample."""
        return sum(phase.frames for phase in self.history)


def load_recipe(name_or_path: str) -> Recipe:
    """The recipe of a packaged name ("presses") or a file.

    Raises InputError with file, line, key, found and expected, for all that is wrong with it.
    """
    path = named_file(name_or_path, "recipe", packaged_recipes())
    return read_recipe(path)


def read_recipe(path: Path) -> Recipe:
    """The recipe of a file; see load_recipe."""
    top = read_yaml(path)
    apart = ("sensor", "indenters")
    rest = {key: value for key, value in top.content.items() if key not in apart}
    keys = replace(top, content=rest).read(RecipeKeys, FORMAT_VERSION)
    found = top.content.get("sensor", NOTHING)
    if not isinstance(found, str):
        raise top.error("sensor", found, "a sensor description's name or path")
    beside = path.parent / found
    try:
        source = beside if beside.is_file() else find_sensor_description(found)
    except InputError as error:
        raise top.error("sensor", found, f"a sensor description ({error})") from None
    file = read_yaml(source)
    recipe = Recipe(
        **{item.name: getattr(keys, item.name) for item in fields(RecipeKeys)},
        sensor=sensor_description_of(file),
        sensor_file=file,
        indenters=tuple(_indenters(top, path.parent)),
        file=top,
    )
    for key in keys.errors:
        _check_number(file, top, key)
    return recipe


def packaged_recipes() -> dict[str, Path]:
    """Names and files of the recipes that come with the package."""
    return packaged_files("cmp_tactile_simulation", "recipes/*.yaml")


def recipe_schema() -> dict[str, Any]:
    """JSON schema of a recipe's file."""
    schema = file_schema(RecipeKeys, FORMAT_VERSION)
    kinds = [part_schema(_shape_keys(kind)) for kind in SHAPES] + [part_schema(MeshKeys)]
    for kind, shape in zip(SHAPES, kinds, strict=False):
        shape["properties"]["type"] = {"const": kind}
    schema["properties"] |= {
        "sensor": {"type": "string"},
        "indenters": {"type": "array", "minItems": 1, "items": {"anyOf": kinds}},
    }
    schema["required"] += ["sensor", "indenters"]
    return schema


@dataclass(frozen=True)
class MeshKeys(Part):
    """Meshes of a recipe.  meshes: a file, or a folder of files; scale: from their unit to m."""

    meshes: str = field(metadata=text())
    scale: Annotated[Distribution, Within(1e-6, 1e3)] = ONE
    edge_radius: Annotated[Distribution | None, Within(*description.SIDE_M, "m")] = None
    weight: float = field(default=1.0, metadata=positive())


@lru_cache
def _shape_keys(kind: str) -> Any:
    """The keys of a shape: its lengths, each a number or a distribution."""
    side = Annotated[Distribution, Within(*description.SIDE_M, "m")]
    own: list[Any] = [("type", str, field())]
    for item in fields(description.INDENTERS[kind]):
        if item.name == "size":
            own.append((item.name, tuple[side, side, side], field()))
        elif item.default is MISSING:
            own.append((item.name, side, field()))
        else:
            default = Distribution(FIXED, (item.default,))
            own.append((item.name, side, field(default=default)))
    own.append(("weight", float, field(default=1.0, metadata=positive())))
    return make_dataclass("Indenter", own, bases=(Part,), frozen=True, kw_only=True)


def _indenters(top: YamlFile, folder: Path) -> Iterator[IndenterKeys]:
    listed = top.content.get("indenters", NOTHING)
    if not isinstance(listed, list) or not listed:
        raise top.error("indenters", listed, "a list of one or more indenters")
    for number_, given in enumerate(listed):
        key = f"indenters[{number_}]"
        if not isinstance(given, dict):
            raise top.error(key, given, "a mapping with `type` or `meshes`")
        file = YamlFile(top.path, given, top.lines, above=key)
        if "meshes" in given:
            yield _meshes(file, folder)
            continue
        kind = given.get("type", NOTHING)
        if kind not in SHAPES:
            near = did_you_mean(str(kind), SHAPES)
            raise file.error("type", kind, f"one of {', '.join(SHAPES)}, or `meshes`{near}")
        read = file.read(_shape_keys(kind))
        values = {
            item.name: getattr(read, item.name)
            for item in fields(read)
            if item.name not in {"type", "weight"}
        }
        yield IndenterKeys(kind=kind, weight=read.weight, values=values)


def _meshes(file: YamlFile, folder: Path) -> IndenterKeys:
    read = file.read(MeshKeys)
    place = folder / read.meshes
    files = (
        sorted(item for item in place.iterdir() if item.suffix.lower() in MESH_SUFFIXES)
        if place.is_dir()
        else [place]
    )
    if not files or not files[0].is_file():
        expected = f"a mesh file, or a folder with some ({', '.join(MESH_SUFFIXES)})"
        raise file.error("meshes", read.meshes, f"{expected}; found none at {place}")
    for path in files:
        # Each is read now, so that one that is not closed stops no run half way.
        MeshIndenter.load(path, read.scale.support[1])
    values = {"scale": read.scale}
    if read.edge_radius is not None:
        values["edge_radius"] = read.edge_radius
    return IndenterKeys(kind="mesh", weight=read.weight, values=values, meshes=tuple(files))


def _check_number(file: YamlFile, top: YamlFile, key: str) -> None:
    """InputError where the key path leads to no number of the sensor description."""
    value: Any = file.content
    for name in key.split("."):
        value = value.get(name) if isinstance(value, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float):
        numbers = sorted(number_paths(file.content))
        near = did_you_mean(key, numbers)
        expected = f"the key path of a number in {file.path}, such as elastomer.young{near}"
        raise top.error(f"errors.{key}", key, expected)


def number_paths(content: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """Key paths of all numbers in nested mappings."""
    for key, value in content.items():
        if isinstance(value, dict):
            yield from number_paths(value, f"{above}{key}.")
        elif isinstance(value, float):
            yield f"{above}{key}"


def with_errors(content: Mapping[str, Any], errors: Mapping[str, float]) -> dict[str, Any]:
    """Nested mappings with some numbers, by key path, times 1 + error."""
    changed = dict(content)
    for key, value in content.items():
        below = {
            path.removeprefix(f"{key}."): error
            for path, error in errors.items()
            if path.startswith(f"{key}.")
        }
        if isinstance(value, dict) and below:
            changed[key] = with_errors(value, below)
        elif key in errors:
            changed[key] = value * (1 + errors[key])
    return changed
