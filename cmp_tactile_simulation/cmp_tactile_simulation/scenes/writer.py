"""Writes a scene out again, as it was resolved: variants, sensor and defaults made explicit."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cmp_tactile_processing.sensor.yaml_text import dump_yaml
from cmp_tactile_simulation.scenes.description import (
    Goal,
    Hold,
    IndenterDescription,
    MoveBy,
    MoveTo,
    Phase,
    Press,
    Release,
    Scene,
    Start,
    Touch,
)

__all__ = ["SCENE_FILE", "SENSOR_FILE", "scene_mapping", "write_scene"]

SCENE_FILE = "scene.yaml"
SENSOR_FILE = "sensor.yaml"


def write_scene(scene: Scene, folder: Path) -> None:
    """Write scene.yaml, sensor.yaml and the indenter's mesh; the scene can be run from there."""
    if scene.indenter.file is not None:
        target = folder / scene.indenter.file.name
        if not target.exists() or not target.samefile(scene.indenter.file):
            shutil.copyfile(scene.indenter.file, target)
    _write(folder / SENSOR_FILE, dict(scene.sensor_mapping))
    _write(folder / SCENE_FILE, scene_mapping(scene))


def scene_mapping(scene: Scene) -> dict[str, Any]:
    """The mapping of scene.yaml: every key of the scene, its sensor description beside it."""
    return {
        "version": 1,
        "name": scene.name,
        "title": scene.title,
        "source": scene.source,
        **({"note": scene.note} if scene.note else {}),
        "sensor": SENSOR_FILE,
        "pattern_type": scene.pattern_type,
        "contact_nodes": scene.contact_nodes,
        "indenter": _indenter(scene.indenter),
        "rate": scene.rate,
        "start": _start(scene.start),
        "motion": [_phase(phase) for phase in scene.motion],
        "camera": asdict(scene.camera),
        "print": asdict(scene.defects),
        "samples": scene.samples,
        "seed": scene.seed,
    }


def _write(path: Path, content: dict[str, Any]) -> None:
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(dump_yaml(content), encoding="utf-8")
    partial.replace(path)


def _indenter(indenter: IndenterDescription) -> dict[str, Any]:
    file = {"file": indenter.file.name} if indenter.file else {}
    values = {key: _plain(value) for key, value in indenter.values.items()}
    return {"type": indenter.type, **file, **values, "friction": indenter.friction}


def _start(start: Start) -> dict[str, Any]:
    rotation = {"rotation_deg": list(start.rotation_deg)}
    if isinstance(start.place, Touch):
        return {"touch": _touch(start.place), **rotation}
    return {"position": list(start.place), **rotation}


def _phase(phase: Phase) -> dict[str, Any]:
    key, value = _goal(phase.goal)
    return {"name": phase.name, "frames": phase.frames, key: value, "easing": phase.easing}


def _goal(goal: Goal) -> tuple[str, Any]:
    if isinstance(goal, MoveTo):
        places = {"position": goal.position, "rotation_deg": goal.rotation_deg}
        return "to", {key: list(value) for key, value in places.items() if value is not None}
    if isinstance(goal, MoveBy):
        return "by", {"position": list(goal.offset), "rotation_deg": list(goal.rotation_deg)}
    if isinstance(goal, Press):
        return "load", {key: _plain(value) for key, value in asdict(goal.load).items()}
    if isinstance(goal, Touch):
        return "touch", _touch(goal)
    if isinstance(goal, Release):
        return "release", goal.clearance
    assert isinstance(goal, Hold)  # noqa: S101  the last of the kinds
    return "hold", True


def _touch(touch: Touch) -> dict[str, Any]:
    return {"at": list(touch.at), "clearance": touch.clearance}


def _plain(value: Any) -> Any:
    """Tuples as lists, which is all that YAML knows."""
    return [_plain(item) for item in value] if isinstance(value, (tuple, list)) else value
