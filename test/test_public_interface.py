"""docs/nodes.md and docs/public_interface.md say what is public; a change is in the changelog."""

from __future__ import annotations

import subprocess
from dataclasses import fields
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

import interface_tables
import public_interface
from rcl_interfaces.msg import ParameterType

from cmp_tactile_processing.sensor.parameters import Parameters

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[1]
UNITS = {"", "Hz", "MB", "N", "N/s", "Pa", "m", "m/(N m)", "m/N", "m/s", "px", "rad", "s"}
UNITS |= {"grey levels"}
NUMBERS = (ParameterType.PARAMETER_DOUBLE, ParameterType.PARAMETER_INTEGER)
NODES, PAGE, CHANGELOG = "docs/nodes.md", "docs/public_interface.md", "CHANGELOG.md"


@pytest.fixture(scope="module")
def interfaces():
    return interface_tables.read_interfaces()


@pytest.mark.parametrize("script", [interface_tables, public_interface])
def test_the_page_is_what_the_code_says(interfaces, script):
    page = NODES if script is interface_tables else PAGE
    _, marker, found = (ROOT / page).read_text(encoding="utf-8").partition(script.MARKER)
    assert marker, f"{page} lacks the line {script.MARKER}"
    assert found.strip() == script.as_markdown(interfaces).strip(), (
        f"run: setup/run python3 docs/{script.__name__}.py {page}\n"
        f"and write a line into {CHANGELOG}, under Unreleased, about what has changed"
    )


def git(*words: str) -> list[str]:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.split()


def test_a_changed_interface_is_in_the_changelog():
    """Since the page last changed, committed or not; nothing is compared without git's history."""
    changed = git("diff", "--name-only", "HEAD")
    commit = git("log", "-1", "--format=%H", "--", PAGE)
    if PAGE not in changed and commit:
        changed = git("diff", "--name-only", f"{commit[0]}^")
    assert CHANGELOG in changed or PAGE not in changed, f"{PAGE} has changed: add to {CHANGELOG}"


def test_every_parameter_and_node_is_described(interfaces):
    """A number has a range; the unit of those that are fields of `Parameters` is one of a few."""
    names = [node.name for node in interfaces]
    assert names[:3] == ["camera_driver", "replay", "recorder"]
    assert names[-2:] == ["web_viewer", "component_container"]
    assert len(names) == 13
    for node in interfaces:
        assert node.description, node.plugin
        assert ("out", "/diagnostics") in {(t.direction, t.name) for t in node.topics}, node.name
        for item, _ in node.parameters:
            where = f"{node.name}: {item.name}"
            assert item.description, where
            assert item.type != ParameterType.PARAMETER_NOT_SET, where
            ranges = item.floating_point_range or item.integer_range or item.additional_constraints
            assert ranges or item.type not in NUMBERS, where
    for kind in Parameters.__subclasses__():
        for field in fields(kind):
            assert field.metadata["unit"] in UNITS, f"{kind.__name__}.{field.name}"
