"""`cmp_tactile schema`: every file that comes with the packages is as its schema says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from command_output import run
from jsonschema import Draft202012Validator

from cmp_tactile_processing.sensor.description import packaged_sensors
from cmp_tactile_processing.sensor.yaml_file import read_yaml
from cmp_tactile_simulation.dataset.recipe import packaged_recipes
from cmp_tactile_simulation.scenes.file import packaged_scenes

FILES = {
    "sensor": packaged_sensors(),
    "scene": packaged_scenes(),
    "recipe": packaged_recipes(),
}


def schema(kind: str, capsys: pytest.CaptureFixture[str]) -> Draft202012Validator:
    """What the command prints, as a checker."""
    assert run("schema", kind) == 0
    found = json.loads(capsys.readouterr().out)
    Draft202012Validator.check_schema(found)
    return Draft202012Validator(found)


@pytest.mark.parametrize("kind", FILES)
def test_files_of_the_packages_fit(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    checker = schema(kind, capsys)
    for path in FILES[kind].values():
        assert not list(checker.iter_errors(read_yaml(path).content)), path


WRONG = {
    "sensor": [("pattern", "pich"), ("pattern", "pitch"), ("elastomer", "young")],
    "scene": [("indenter", "diameter"), ("camera", "blurr"), ("start", "touch")],
    "recipe": [("camera", "blurr"), ("depth", "unifrom")],
}


@pytest.mark.parametrize(("kind", "place"), [(k, p) for k, places in WRONG.items() for p in places])
def test_a_wrong_key_or_value_does_not_fit(
    kind: str, place: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    path: Path = FILES[kind][{"sensor": "sample_rig", "scene": "grasp", "recipe": "presses"}[kind]]
    content: dict[str, Any] = read_yaml(path).content
    section, key = place
    content[section] = {**content.get(section, {}), key: "wide"}
    errors = list(schema(kind, capsys).iter_errors(content))
    assert [error.absolute_path[0] for error in errors] == [section]


def test_other_kinds_of_files_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("schema", "bag") == 2
    assert "expected sensor, scene or recipe" in capsys.readouterr().err
