"""Tables of the benchmarks: Markdown, limits with what was measured, figures that are kept."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

VERDICTS = {None: "-", True: "yes", False: "NO"}


def line(*cells: object) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |"


def head(*names: object) -> str:
    """The first two lines of a Markdown table."""
    return f"{line(*names)}\n{'|---' * len(names)}|"


@dataclass(frozen=True)
class Limit:
    """A line of a table: what, its limit ("-" for none), what was measured, whether it is met.

    met: None where there is no limit.  table: where the line belongs.
    """

    name: str
    limit: str
    measured: str
    met: bool | None
    table: str = ""


class LimitRun:
    """Measures limits, part by part; the method `_PART` of a subclass yields those of a part."""

    PARTS: ClassVar[tuple[str, ...]]

    def show(self, parts: Sequence[str] = ()) -> list[Limit]:
        """The limits of these parts, each printed as it comes; all where none is named."""
        done: list[Limit] = []
        print(f"{'limit':58s} | {'':8s} | {'measured':44s} | met")
        for part in self.PARTS:
            if not parts or part in parts:
                for row in getattr(self, f"_{part}")():
                    name = f"{row.table}: {row.name}" if row.table else row.name
                    print(
                        f"{name:58s} | {row.limit:8s} | {row.measured:44s} | {VERDICTS[row.met]}",
                        flush=True,
                    )
                    done.append(row)
        print(f"{missed(done)} limits missed")
        return done


def missed(limits: Iterable[Limit]) -> int:
    """How many are not met."""
    return sum(limit.met is False for limit in limits)


class CommandLine(argparse.ArgumentParser):
    """That of a benchmark, described by its module."""

    def __init__(self, description: str | None) -> None:
        style = argparse.RawDescriptionHelpFormatter
        super().__init__(description=description, formatter_class=style)

    def option(self, name: str, text: str, default: Any = None, **given: Any) -> None:
        """An option of the type of its default, which the help names; False: a switch."""
        if default is False:
            given |= {"action": "store_true"}
        elif default is not None:
            given = {"type": type(default), "default": default, **given}
            text += " (default: %(default)s)"
        self.add_argument(name, help=text, **given)

    def add_json(self) -> None:
        """The option --json."""
        self.option("--json", "write the figures into this file", type=Path, metavar="FILE")


def keep(path: Path, figures: Mapping[str, Any]) -> None:
    """Write figures into a file of results; what it has of other inputs stays there."""
    known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    path.write_text(json.dumps({**known, **figures}, indent=1) + "\n", encoding="utf-8")
