"""Tables of the stages' parameters for the documentation, from their dataclasses.

`python3 -m cmp_tactile_processing.sensor.parameter_table docs/sensor_description.md` renews
what follows the marker line of that file.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

from cmp_tactile_processing.sensor import parameters

MARKER = "<!-- made by cmp_tactile_processing.sensor.parameter_table from here on -->"
STAGES = {
    "tracking": parameters.TrackingParameters,
    "triangulation": parameters.TriangulationParameters,
    "force": parameters.ForceParameters,
    "slip": parameters.SlipParameters,
}


def as_markdown() -> str:
    """One table a stage."""
    return "\n".join(line for name, stage in STAGES.items() for line in parameter_rows(name, stage))


def parameter_rows(name: str, stage: Any) -> Iterator[str]:
    """Lines of the table of a dataclass with fields of `parameter`."""
    yield f"### {name}\n"
    yield "| key | default | allowed | meaning |\n|---|---|---|---|"
    for item in fields(stage):
        meta = item.metadata
        default = f"{item.default:g}" if isinstance(item.default, float) else item.default
        default = str(default).lower() if isinstance(default, bool) else default
        default = f"{default} {meta['unit']}".strip()
        yield f"| `{item.name}` | {default} | {_allowed(item)} | {meta['description']} |"
    yield ""


def _allowed(item: Field[Any]) -> str:
    meta = item.metadata
    if isinstance(item.default, bool):
        return "true, false"
    if meta["choices"]:
        return ", ".join(meta["choices"])
    bounds = {"at least": meta["low"], "at most": meta["high"]}
    return ", ".join(f"{word} {bound:g}" for word, bound in bounds.items() if bound is not None)


def with_generated_section(path: Path, marker: str, section: str) -> str:
    """The text of the file with everything after its marker line replaced by the section.

    Raises ValueError where the file has no such line.
    """
    preamble, found, _ = path.read_text(encoding="utf-8").partition(marker)
    if not found:
        msg = f"{path}: found no line {marker!r}, expected it where the generated part begins"
        raise ValueError(msg)
    return f"{preamble}{marker}\n\n{section}"


def renew(path: Path) -> str:
    """The text of the file with its tables made again."""
    return with_generated_section(path, MARKER, as_markdown())


def renew_file(renew: Callable[[Path], str]) -> None:
    """Write the file that the command line names again, with the text that `renew` gives."""
    target = Path(sys.argv[1])
    target.write_text(renew(target), encoding="utf-8")


if __name__ == "__main__":
    renew_file(renew)
