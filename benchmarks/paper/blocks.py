"""What a report is made of: texts, tables, figures and claims; what is written is in prose.yaml."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml


@dataclass(frozen=True)
class Claim:
    """A figure or sentence of the paper beside ours.

    section: of the paper.  met: None where the paper states nothing that could be missed.
    """

    section: str
    what: str
    paper: str
    ours: str
    met: bool | None


@dataclass(frozen=True)
class Deviation:
    """Where an experiment departs from the paper's set-up, and why."""

    what: str
    paper: str
    here: str
    why: str


@dataclass(frozen=True)
class Text:
    """A paragraph; `code` between backquotes, nothing else is marked up."""

    text: str


@dataclass(frozen=True)
class Table:
    """A table; rows of texts, the first column is a name."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""

    @classmethod
    def from_columns(
        cls,
        columns: Mapping[str, Callable[..., str]],
        rows: Iterable[tuple[Any, ...]],
        caption: str = "",
    ) -> Table:
        """Each column is its heading and a function that writes its cell of a row.

        rows: tuples of what these functions take.
        """
        cells = tuple(tuple(write(*row) for write in columns.values()) for row in rows)
        return cls(tuple(columns), cells, caption)


@dataclass(frozen=True)
class Figure:
    """A PNG file that the report has written."""

    path: Path
    caption: str


Block = Text | Table | Figure


@dataclass(frozen=True)
class Report:
    """What an experiment found: blocks in reading order, claims for the last table."""

    blocks: tuple[Block, ...]
    claims: tuple[Claim, ...] = ()
    deviations: tuple[Deviation, ...] = ()


@cache
def _prose() -> dict[str, Any]:
    """All that is written on the page, by experiment."""
    path = Path(__file__).with_name("prose.yaml")
    texts: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return texts


def prose(experiment: str, name: str, **values: object) -> Text:
    """A paragraph of prose.yaml with its fields filled in."""
    return Text(_prose()[experiment]["texts"][name].format(**values))


def deviations(experiment: str, **values: object) -> tuple[Deviation, ...]:
    """All departures of an experiment from the paper, with their fields filled in."""
    rows = _prose()[experiment]["deviations"]
    return tuple(Deviation(**{k: text.format(**values) for k, text in row.items()}) for row in rows)
