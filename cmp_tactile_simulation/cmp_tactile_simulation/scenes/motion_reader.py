"""Reads the phases of a scene's motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from cmp_tactile_processing.sensor.yaml_section import YamlSection, meant
from cmp_tactile_simulation.contact.state import Load
from cmp_tactile_simulation.scenes.description import (
    EASINGS,
    Goal,
    Hold,
    MoveBy,
    MoveTo,
    Phase,
    Press,
    Release,
    Touch,
    Vector,
)

__all__ = ["MAX_FRAMES", "MAX_REACH_M", "reach_text", "read_motion", "read_rotation", "read_touch"]

MAX_FRAMES = 100_000
MAX_REPEATS = 1000
MAX_DEPTH = 8
MAX_PHASE_S = 3600.0
MAX_REACH_M = 0.2
MAX_LOAD_N = 1000.0
MAX_TORQUE_NM = 10.0

Point = tuple[float, float]


class _Context(NamedTuple):
    """What phases mean depends on: frames/s; of a group its point, number (" 1") and depth."""

    rate: float
    point: Point | None = None
    number: str = ""
    depth: int = 0


def read_motion(top: YamlSection, rate: float) -> tuple[Phase, ...]:
    """The phases of `motion` in order, those of a group once for each of its points.

    rate: frames/s, which makes frames of durations.
    Raises DescriptionError for a wrong key, for no phases and for too many frames.
    """
    phases: list[Phase] = []
    frames = 0
    for phase in _phases(top, _Context(rate)):
        frames += phase.frames
        if frames > MAX_FRAMES:
            # Groups in groups may hold more phases than can be listed.
            raise top.error("motion", f"{frames} frames or more", f"1 to {MAX_FRAMES} frames")
        phases.append(phase)
    return tuple(phases)


def read_rotation(section: YamlSection) -> Vector:
    """The optional key rotation_deg."""
    if "rotation_deg" not in section:
        return 0.0, 0.0, 0.0
    x, y, z = section.numbers("rotation_deg", 3)
    return x, y, z


def read_touch(section: YamlSection, point: Point | None = None) -> Touch:
    """A place to touch; point: of the group, where there is one."""
    at = point if point is not None and "at" not in section else _point(section, "at")
    clearance = (
        section.quantity("clearance", "m", 0.0, MAX_REACH_M) if "clearance" in section else 0.0
    )
    section.finish()
    return Touch(at, clearance)


def reach_text(found: Sequence[float], limit: float = MAX_REACH_M) -> str:
    """What is expected instead of a place that is too far away."""
    return f"m, each at most {limit:g}{meant(found, 'm', -limit, limit)}"


def _phases(section: YamlSection, context: _Context) -> Iterator[Phase]:
    if context.depth > MAX_DEPTH:
        raise section.error("motion", "one more", f"at most {MAX_DEPTH} groups in each other")
    items = list(section.sections("motion"))
    if not items:
        raise section.error("motion", "no phases", "at least one")
    for item in items:
        if "motion" in item:
            yield from _group(item, context)
        else:
            yield _read_phase(item, context)


def _group(section: YamlSection, context: _Context) -> Iterator[Phase]:
    """The phases of a group, once for each of its points or as often as it says."""
    if ("points" in section) == ("repeat" in section):
        raise section.error("", "a group", "either `points` or `repeat` beside its `motion`")
    points: list[Point | None]
    if "points" in section:
        points = [*_read_points(section)]
    else:
        points = [context.point] * section.integer("repeat", 1, MAX_REPEATS)
    for number, point in enumerate(points, start=1):
        name = f"{context.number} {number}"
        yield from _phases(section, _Context(context.rate, point, name, context.depth + 1))
    section.finish()


def _read_points(section: YamlSection) -> list[Point]:
    expected = f"a list of 1 to {MAX_REPEATS} points [x, y]"
    points = section.raw("points", expected)
    if not isinstance(points, list) or not 0 < len(points) <= MAX_REPEATS:
        raise section.error("points", points, expected)
    return [(x, y) for x, y in section.number_rows("points", len(points), 2)]


def _read_phase(section: YamlSection, context: _Context) -> Phase:
    name = section.text("name")
    kinds = [kind for kind in _READERS if kind in section]
    if len(kinds) != 1:
        raise section.error("", kinds or "none of them", f"one of {', '.join(_READERS)}")
    phase = Phase(
        name=f"{name}{context.number}",
        frames=_read_frames(section, context.rate),
        goal=_READERS[kinds[0]](section, context.point),
        easing=section.choice("easing", EASINGS) if "easing" in section else Phase.easing,
    )
    section.finish()
    return phase


def _read_frames(section: YamlSection, rate: float) -> int:
    if ("frames" in section) == ("duration" in section):
        both = "both" if "frames" in section else "neither"
        raise section.error("", both, "either `frames` or `duration`")
    if "frames" in section:
        return section.integer("frames", 1, MAX_FRAMES)
    frames = round(section.positive("duration", MAX_PHASE_S) * rate)
    if not 0 < frames <= MAX_FRAMES:
        expected = f"1 to {MAX_FRAMES} frames at {rate:g} Hz"
        raise section.error("duration", f"{frames} frames", expected)
    return frames


def _read_hold(section: YamlSection, _: Point | None) -> Goal:
    if section.raw("hold", "true") is not True:
        raise section.error("hold", section.raw("hold"), "true")
    return Hold()


def _read_to(section: YamlSection, _: Point | None) -> Goal:
    place = section.section("to")
    if "position" not in place and "rotation_deg" not in place:
        raise place.error("", "neither", "`position`, `rotation_deg` or both")
    goal = MoveTo(
        _vector(place, "position", MAX_REACH_M) if "position" in place else None,
        read_rotation(place) if "rotation_deg" in place else None,
    )
    place.finish()
    return goal


def _read_by(section: YamlSection, _: Point | None) -> Goal:
    step = section.section("by")
    if "position" not in step and "rotation_deg" not in step:
        raise step.error("", "neither", "`position`, `rotation_deg` or both")
    nowhere = (0.0, 0.0, 0.0)
    offset = _vector(step, "position", MAX_REACH_M) if "position" in step else nowhere
    goal = MoveBy(offset, _turn(step) if "rotation_deg" in step else nowhere)
    step.finish()
    return goal


def _read_load(section: YamlSection, _: Point | None) -> Goal:
    values = section.section("load")
    x, y = values.numbers("tangential", 2) if "tangential" in values else (0.0, 0.0)
    if max(abs(x), abs(y)) > MAX_LOAD_N:
        raise values.error("tangential", [x, y], f"N, each at most {MAX_LOAD_N:g}")
    torque = 0.0
    if "torque" in values:
        torque = values.number("torque", -MAX_TORQUE_NM, MAX_TORQUE_NM)
    load = Load(values.number("normal", 0.0, MAX_LOAD_N), (x, y), torque)
    values.finish()
    return Press(load)


def _read_touch(section: YamlSection, point: Point | None) -> Goal:
    return read_touch(section.section("touch"), point)


def _read_release(section: YamlSection, _: Point | None) -> Goal:
    return Release(section.quantity("release", "m", 0.0, MAX_REACH_M))


_READERS: dict[str, Callable[[YamlSection, Point | None], Goal]] = {
    "to": _read_to,
    "by": _read_by,
    "load": _read_load,
    "touch": _read_touch,
    "hold": _read_hold,
    "release": _read_release,
}


def _turn(section: YamlSection) -> Vector:
    """A turn of less than half a revolution, beyond which the way there is not defined."""
    turn = read_rotation(section)
    if sum(angle**2 for angle in turn) >= 180.0**2:
        raise section.error("rotation_deg", list(turn), "a turn of less than 180 degrees a phase")
    return turn


def _vector(section: YamlSection, key: str, limit: float) -> Vector:
    x, y, z = section.numbers(key, 3)
    if max(abs(x), abs(y), abs(z)) > limit:
        raise section.error(key, [x, y, z], reach_text([x, y, z], limit))
    return x, y, z


def _point(section: YamlSection, key: str) -> Point:
    x, y = section.numbers(key, 2)
    if max(abs(x), abs(y)) > MAX_REACH_M:
        raise section.error(key, [x, y], reach_text([x, y]))
    return x, y
