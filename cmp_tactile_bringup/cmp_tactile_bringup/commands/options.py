"""Options of the subcommands: each is declared once, as a field of its subcommand's class."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from inspect import Parameter, Signature, getdoc
from types import NoneType
from typing import Annotated, Any, NoReturn, get_args, get_type_hints

import typer
from typer.core import TyperCommand
from typer.models import OptionInfo

# That of click, or of the copy of click that newer versions of typer contain.
UsageError: Any = typer.BadParameter.__base__


@dataclass(frozen=True)
class Number:
    """A number from low to high, both included; kind: int for a whole one."""

    low: float
    high: float
    unit: str = ""
    kind: type[float] = float

    @property
    def metavar(self) -> str:
        """What stands for it in the help."""
        return self.unit.upper() or ("N" if self.kind is int else "X")

    def parse(self, text: str | float) -> float:
        """The number; BadParameter names the range.  A default is not checked."""
        if not isinstance(text, str):
            return text
        what, form = ("a whole number", "d") if self.kind is int else ("a number", "g")
        try:
            value = self.kind(text)
        except ValueError:
            value = float("nan")
        if not self.low <= value <= self.high:
            span = f"of at least {self.low:{form}}"
            if math.isfinite(self.high):
                span = f"from {self.low:{form}} to {self.high:{form}}"
            expected = f"{what} {span} {self.unit}".rstrip()
            msg = f"found {text!r}, expected {expected}"
            raise typer.BadParameter(msg)
        return value


@dataclass(frozen=True)
class Choice:
    """One of some words."""

    words: tuple[str, ...]

    @property
    def metavar(self) -> str:
        """What stands for it in the help."""
        return "|".join(self.words)

    def parse(self, text: str) -> str:
        """The word; BadParameter lists all of them."""
        if text not in self.words:
            from cmp_tactile_processing.sensor.yaml_file import did_you_mean

            msg = f"found {text!r}, expected one of {', '.join(self.words)}"
            raise typer.BadParameter(msg + did_you_mean(text, self.words))
        return text

    def complete(self, incomplete: str) -> list[str]:
        """The words that begin so."""
        return [word for word in self.words if word.startswith(incomplete)]


@dataclass(frozen=True)
class Pair:
    """Two whole numbers with an x between; expected: what they are, with an example."""

    expected: str
    low: int = 0

    def parse(self, text: str) -> str:
        """The text; BadParameter says what is expected."""
        one, _, other = text.lower().partition("x")
        if one.isdigit() and other.isdigit() and min(int(one), int(other)) >= self.low:
            return text.lower()
        msg = f"found {text!r}, expected {self.expected}"
        raise typer.BadParameter(msg)


def option(
    text: str,
    convert: Number | Choice | Callable[[str], Any] | None = None,
    *,
    metavar: str | None = None,
    group: str | None = None,
    short: str = "",
) -> Any:
    """An option, named as its field.

    A metavar that ends in "..." lets a list take all words up to the next option.
    """
    info = typer.Option(
        help=text,
        parser=convert.parse if isinstance(convert, Number | Choice) else convert,
        metavar=convert.metavar
        if isinstance(convert, Number | Choice) and not metavar
        else metavar,
        autocompletion=convert.complete if isinstance(convert, Choice) else None,
        rich_help_panel=group,
    )
    info.param_decls = (short,) if short else ()
    return info


def parameter_option(parameters: Any, name: str, *, group: str | None = None) -> Any:
    """An option with description, limits and choices of a field of these Parameters."""
    item = parameters.__dataclass_fields__[name]
    meta, kind = item.metadata, type(item.default)
    if meta["choices"]:
        return option(meta["description"], Choice(meta["choices"]), group=group)
    if kind not in {int, float}:
        return option(meta["description"], group=group)
    low = -math.inf if meta["low"] is None else meta["low"]
    high = math.inf if meta["high"] is None else meta["high"]
    return option(meta["description"], Number(low, high, meta["unit"], kind), group=group)


RecordingSensor = Annotated[
    str | None,
    option(
        "sensor description: a file or a packaged name; not needed for a packaged scene, or with a "
        "sensor.yaml in the recording's folder"
    ),
]
"""The sensor of a recording, which may name it itself."""


def argument(metavar: str, text: str) -> Any:
    """A word, or a list of words, without an option's name before it."""
    return typer.Argument(metavar=metavar, help=text)


def misuse(message: str) -> NoReturn:
    """End with the exit code of a wrong option."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


@dataclass(frozen=True, kw_only=True)
class Command:
    """A subcommand with the values of its options; the docstring of its class is its help."""

    debug: Annotated[bool, option("show the traceback of an error")] = False

    def run(self) -> int:
        """Do the work; returns the exit code."""
        raise NotImplementedError

    def check_exclusive(self, *names: str) -> None:
        """End so where more than one of these options was given."""
        given = [_long_name(name) for name in names if getattr(self, name)]
        if len(given) > 1:
            misuse(f"{given[1]}: not allowed with {given[0]}")


class _TyperCommand(TyperCommand):
    """A command with options that take several words, as a shell makes of left*.jpg."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeat such an option before each of its words."""
        several = {
            name
            for parameter in self.params
            if (getattr(parameter, "metavar", None) or "").endswith("...")
            for name in parameter.opts
        }
        words, repeated = list[str](), ""
        for word in args:
            if word.startswith("-"):
                repeated = word if word in several else ""
            elif repeated and words[-1] != repeated:
                words.append(repeated)
            words.append(word)
        return super().parse_args(ctx, words)

    def invoke(self, ctx: Any) -> Any:
        """Leave what was not given to the class; versions of typer before 0.12 fail on a tuple."""
        ctx.params = {name: value for name, value in ctx.params.items() if value is not None}
        return super().invoke(ctx)


def add_subcommand(app: typer.Typer, name: str, summary: str, made: type[Command]) -> None:
    """Let the app make an instance of the class from the words of a command line."""
    parameters, hints = [], get_type_hints(made, include_extras=True)
    for item in sorted(fields(made), key=lambda item: item.name == "debug"):
        kind, info = get_args(hints[item.name])
        if isinstance(info, OptionInfo):
            info.param_decls = (*(info.param_decls or ())[:1], _long_name(item.name))
        info.show_default = item.default not in {MISSING, None, ""}
        # Versions of typer before 0.12 do not know `X | None`.
        kind = next(iter(set(get_args(kind)) - {NoneType})) if NoneType in get_args(kind) else kind
        default = Parameter.empty if item.default is MISSING else item.default
        parameters.append(
            Parameter(
                item.name,
                Parameter.KEYWORD_ONLY,
                default=default,
                annotation=Annotated[kind, info],
            )
        )

    def make(**values: Any) -> Command:
        return made(**values)

    make.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    make.__annotations__ = {item.name: item.annotation for item in parameters}
    text = "\n\n".join(map(_as_written, (getdoc(made) or "").split("\n\n")))
    app.command(name, cls=_TyperCommand, help=text, short_help=summary)(make)


def _as_written(paragraph: str) -> str:
    """Keep the lines of a paragraph that has indented ones."""
    return f"\b\n{paragraph}" if "\n  " in f"\n{paragraph}" else paragraph


def _long_name(name: str) -> str:
    """The option of a field; "set_" stands for "set", which Python has taken."""
    return f"--{name.rstrip('_').replace('_', '-')}"
