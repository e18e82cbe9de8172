"""Findings of calibrations, with the texts of findings.yaml."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from cmp_tactile_processing.calibration.outcome import Finding, Severity
from cmp_tactile_processing.sensor.yaml_file import read_yaml


@cache
def finding_texts() -> dict[str, dict[str, str]]:
    """Text and advice of every finding, by its name."""
    return dict(read_yaml(Path(__file__).with_suffix(".yaml")).content)


def finding(name: str, /, *, error: bool, **values: Any) -> Finding:
    """The finding of that name with these values in its texts; a warning unless it is an error."""
    texts = finding_texts()[name]
    text, advice = (texts[part].format_map(values) for part in ("text", "advice"))
    return Finding(Severity.ERROR if error else Severity.WARNING, text, advice)
