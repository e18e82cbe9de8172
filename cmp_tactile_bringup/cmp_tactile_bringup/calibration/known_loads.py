"""The file of known loads: which weight, or force, was on the gel in which recording, and when."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.yaml_section import YamlSection, read_yaml

__all__ = ["STANDARD_GRAVITY", "KnownLoad", "read_known_loads", "weight_on_gel"]

STANDARD_GRAVITY = 9.80665
LEAST_GRAVITY, MOST_GRAVITY = 9.7, 9.9
STRAIGHT_IN = (0.0, 0.0, -1.0)
MOST_KG, MOST_N, MOST_S = 100.0, 1000.0, 1e6
MOST_DIRECTION = 1e6
# Where the file does not say how well a load is known: relative, and by how much a weight may hang
# askew, degrees.
MASS_STD, FORCE_STD, TILT_STD_DEG = 0.002, 0.01, 1.0


@dataclass(frozen=True)
class KnownLoad:
    """A load on the gel and the frames that show it.

    name: for people.  force, std (3,) N: on the gel, gel frame, with standard deviations.
    recording: None for the one that the command is given.  time_s: its part, in seconds from its
    first frame; None for where the gel is loaded and stands still.
    """

    name: str
    force: NDArray[np.float64]
    std: NDArray[np.float64]
    recording: Path | None = None
    time_s: tuple[float, float] | None = None


def weight_on_gel(
    mass: float,
    std: float | None = None,
    direction: tuple[float, ...] = STRAIGHT_IN,
    gravity: float = STANDARD_GRAVITY,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Force of a mass (kg) on the gel and its standard deviations, (3,) N each.

    std: of the mass, kg.  direction: in which it is pulled, gel frame, of any length above 0.
    """
    along = np.array(direction) / np.linalg.norm(direction)
    weight = mass * gravity
    sure = (MASS_STD * mass if std is None else std) * gravity
    aside = weight * math.tan(math.radians(TILT_STD_DEG))
    return weight * along, np.sqrt((along * sure) ** 2 + (1 - along**2) * aside**2)


def read_known_loads(path: Path) -> tuple[tuple[KnownLoad, ...], tuple[float, float] | None]:
    """The loads of a YAML file, and when nothing touches the gel (None where it does not tell).

    Raises DescriptionError naming file, key, what was found and what is expected.
    """
    path = path.expanduser()
    section = read_yaml(path)
    gravity = STANDARD_GRAVITY
    if "gravity" in section:
        gravity = section.number("gravity", LEAST_GRAVITY, MOST_GRAVITY)
    rest = _interval(section, "rest") if "rest" in section else None
    loads = tuple(_read_load(item, path.parent, gravity) for item in section.sections("loads"))
    if not loads:
        raise section.error("loads", [], "a list of known loads")
    for number, load in enumerate(loads):
        if load.recording is None and _overlap(rest, load.time_s):
            expected = f"no part of rest, {list(rest or ())}, when nothing touches the gel"
            raise section.error(f"loads[{number}].time", list(load.time_s or ()), expected)
    section.finish()
    return loads, rest


def _read_load(section: YamlSection, folder: Path, gravity: float) -> KnownLoad:
    if ("mass" in section) == ("force" in section):
        found = "both" if "mass" in section else "neither"
        raise section.error("", f"{found} of mass and force", "one of them")
    if "mass" in section:
        force, std = _read_weight(section, gravity)
        name = _mass_text(section.positive("mass", MOST_KG))
    else:
        force, std = _read_force(section)
        name = f"{np.linalg.norm(force):.3g} N"
    recording = None
    if "recording" in section:
        text = section.text("recording")
        beside = folder / Path(text).expanduser()
        recording = beside if beside.exists() else Path(text)
    load = KnownLoad(
        name=section.text("name") if "name" in section else name,
        force=force,
        std=std,
        recording=recording,
        time_s=_interval(section, "time") if "time" in section else None,
    )
    section.finish()
    return load


def _read_weight(
    section: YamlSection, gravity: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    mass = section.positive("mass", MOST_KG)
    std = section.positive("std", mass) if "std" in section else None
    direction: tuple[float, ...] = STRAIGHT_IN
    if "direction" in section:
        direction = section.numbers("direction", 3)
        if not 0 < math.hypot(*direction) <= MOST_DIRECTION:
            expected = f"a direction, not 0, of a length up to {MOST_DIRECTION:g}"
            raise section.error("direction", list(direction), expected)
    return weight_on_gel(mass, std, direction, gravity)


def _read_force(section: YamlSection) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    force = np.array(section.numbers("force", 3))
    size = math.hypot(*force)
    if not 0 < size <= MOST_N:
        raise section.error("force", force.tolist(), f"a force above 0, at most {MOST_N:g} N")
    std = section.positive("std", MOST_N) if "std" in section else FORCE_STD * size
    return force, np.full(3, std)


def _interval(section: YamlSection, key: str) -> tuple[float, float]:
    begin, end = section.numbers(key, 2)
    if not 0 <= begin < end <= MOST_S:
        raise section.error(key, [begin, end], "seconds [from, to], from below to")
    return begin, end


def _overlap(one: tuple[float, float] | None, other: tuple[float, float] | None) -> bool:
    return one is not None and other is not None and one[0] < other[1] and other[0] < one[1]


def _mass_text(mass: float) -> str:
    return f"{mass:.4g} kg" if mass >= 1 else f"{mass * 1e3:.4g} g"
