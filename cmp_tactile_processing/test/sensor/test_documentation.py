"""docs/sensor_description.md says what the code does."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest
import yaml

from cmp_tactile_processing.sensor.parameter_table import renew
from cmp_tactile_processing.sensor.parts import GelRelaxation, MaterialRecord, Pattern

REPOSITORY = Path(__file__).parents[3]
DOCUMENT = REPOSITORY / "docs" / "sensor_description.md"


def test_parameter_tables_are_the_dataclasses():
    assert DOCUMENT.read_text() == renew(DOCUMENT), (
        "run: python3 -m cmp_tactile_processing.sensor.parameter_table docs/sensor_description.md"
    )


def test_every_key_of_the_example_is_documented():
    text = DOCUMENT.read_text()
    example = REPOSITORY / "cmp_tactile_processing" / "config" / "sample_rig.yaml"
    for section, content in yaml.safe_load(example.read_text()).items():
        assert re.search(rf"`(views\.\*|{section})", text), section
        for key in content if isinstance(content, dict) else ():
            assert re.search(rf"`[\w.*]*\b{key}`", text), f"{section}.{key}"


@pytest.mark.parametrize(
    ("section", "record"),
    [
        ("pattern", Pattern),
        ("elastomer.relaxation", GelRelaxation),
        ("elastomer.calibration", MaterialRecord),
    ],
)
def test_every_key_of_a_section_is_documented(section, record):
    text = DOCUMENT.read_text()
    rows = "".join(re.findall(rf"^\| `{section}\..*$", text, re.MULTILINE))
    for item in dataclasses.fields(record):
        assert re.search(rf"`[\w.]*\b{item.name}`", rows), f"{section}.{item.name}"
