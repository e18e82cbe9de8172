"""Graph files and the parts that they include, as written: nothing is filled in yet."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.graphs.arguments import (
    Argument,
    Condition,
    Value,
    argument_values,
    arguments_of,
    conditions_of,
    fits,
)
from cmp_tactile_processing.sensor.yaml_section import YamlSection, read_yaml

__all__ = [
    "ComponentEntry",
    "GraphFile",
    "Include",
    "fill",
    "fill_text",
    "read_graph_file",
]

ARGUMENT = re.compile(r"\$\((\w+(?:\.\w+)?)\)")


@dataclass(frozen=True)
class ComponentEntry:
    """A component of a file, and on what it depends."""

    section: YamlSection
    conditions: tuple[Condition, ...]


@dataclass(frozen=True)
class Include:
    """Another file in the place of a component.

    given: values of its arguments, in which those of the including file may stand; defaults: of
    its other arguments, which become the including file's with the prefix before their names.
    choices: of the including file's own arguments.
    """

    file: GraphFile
    section: YamlSection
    prefix: str
    given: Mapping[str, Value]
    defaults: Mapping[str, Value]
    conditions: tuple[Condition, ...]
    choices: Mapping[str, tuple[str, ...]]

    def arguments(self) -> Iterator[Argument]:
        """The arguments that it leaves to the including file, under their names there."""
        for argument in self.file.arguments():
            conditions = self._conditions_outside(argument)
            if argument.name in self.given or conditions is None:
                continue
            yield replace(
                argument,
                name=self.prefix + argument.name,
                default=self.defaults.get(argument.name, argument.default),
                conditions=(*self.conditions, *conditions),
            )

    def excludes(self, other: Include) -> bool:
        """Whether it stands for the same file where that one's conditions do not hold."""
        return self.file.path == other.file.path and any(
            mine.excludes(theirs) for mine in self.conditions for theirs in other.conditions
        )

    def values(self, outside: Mapping[str, Value]) -> dict[str, Value]:
        """The values of its arguments from those of the including file."""
        given: dict[str, Value] = {}
        declared = self.file.arguments()
        for argument in declared:
            if argument.name in self.given:
                given[argument.name] = fill(
                    self.section, "arguments", self.given[argument.name], outside
                )
            elif self.prefix + argument.name in outside:
                given[argument.name] = outside[self.prefix + argument.name]
        return argument_values(self.file.path, declared, given)

    def _conditions_outside(self, argument: Argument) -> tuple[Condition, ...] | None:
        """The argument's conditions in the including file's names; None where none can hold."""
        found = []
        for condition in argument.conditions:
            if condition.argument not in self.given:
                found.append(replace(condition, argument=self.prefix + condition.argument))
                continue
            given = self.given[condition.argument]
            names = ARGUMENT.findall(given) if isinstance(given, str) else []
            if not names:
                if not condition.holds(given):
                    return None
            elif given == f"$({names[0]})":
                possible = condition.among(self.choices.get(names[0], ()))
                if possible is None:
                    return None
                found.append(replace(possible, argument=names[0]))
        return tuple(found)


@dataclass(frozen=True)
class GraphFile:
    """A graph, or a part of one.  top: its keys beside `arguments` and `components`."""

    path: Path
    top: YamlSection
    own_arguments: tuple[Argument, ...]
    entries: tuple[ComponentEntry | Include, ...]

    def arguments(self) -> tuple[Argument, ...]:
        """Its own arguments, and those that its includes leave to it.

        Includes of one file of which only one can count share them.  Raises DescriptionError where
        two others have one name.
        """
        found = {argument.name: argument for argument in self.own_arguments}
        origins: dict[str, Include] = {}
        for include in self.entries:
            if not isinstance(include, Include):
                continue
            for argument in include.arguments():
                origin = origins.get(argument.name)
                if origin is not None and include.excludes(origin):
                    # It has an effect where it has with either of them.
                    common = set(argument.conditions) & set(found[argument.name].conditions)
                    kept = (item for item in argument.conditions if item in common)
                    found[argument.name] = replace(argument, conditions=tuple(kept))
                    continue
                if argument.name in found:
                    where = f"include of {include.file.path.name}"
                    expected = "every argument with a name of its own, or a value"
                    raise include.section.error("arguments", f"{argument.name}, {where}", expected)
                found[argument.name] = argument
                origins[argument.name] = include
        return tuple(found.values())


def read_graph_file(path: Path, including: tuple[Path, ...] = ()) -> GraphFile:
    """A file with all that it includes.  including: the files through which it is reached.

    Raises DescriptionError naming file, key, found and expected.
    """
    top = _read(path)
    own = arguments_of(top)
    chain = (*including, path.resolve())
    entries: list[ComponentEntry | Include] = []
    for section in top.sections("components"):
        if "include" in section:
            entries.append(_read_include(path, section, own, chain))
        else:
            entries.append(ComponentEntry(section, conditions_of(section, own)))
    return GraphFile(path, top, own, tuple(entries))


def fill_text(section: YamlSection, key: str, text: str, values: Mapping[str, Value]) -> Value:
    """The text with arguments filled in; a text that is one argument alone gives its value."""
    for name in ARGUMENT.findall(text):
        if name not in values:
            allowed = ", ".join(values)
            raise section.error(key, text, f"$(NAME) with NAME one of: {allowed}")
    alone = ARGUMENT.fullmatch(text)
    if alone:
        return values[alone[1]]
    return ARGUMENT.sub(lambda match: str(values[match[1]]), text)


def fill(section: YamlSection, key: str, raw: Value, values: Mapping[str, Value]) -> Value:
    """The value; one that is a text with arguments filled in."""
    return fill_text(section, key, raw, values) if isinstance(raw, str) else raw


def _read(path: Path) -> YamlSection:
    """The file's keys; a part that several sensors share is parsed once."""
    try:
        state = path.stat()
    except OSError:
        return read_yaml(path)
    return YamlSection(path, "", _content(path, state.st_mtime_ns, state.st_size))


@lru_cache(maxsize=64)
def _content(path: Path, _written_ns: int, _size: int) -> dict[str, Any]:
    return dict(read_yaml(path).items())


def _read_include(
    path: Path, section: YamlSection, own: tuple[Argument, ...], chain: tuple[Path, ...]
) -> Include:
    target = path.parent / section.text("include")
    if not target.is_file():
        expected = f"a file ({target}: cannot be read: the file does not exist)"
        raise section.error("include", section.text("include"), expected)
    if target.resolve() in chain:
        raise section.error("include", str(target), "a file that does not include this one")
    file = read_graph_file(target, chain)
    declared = {argument.name: argument for argument in file.arguments()}
    include = Include(
        file=file,
        section=section,
        prefix=section.text("prefix") if "prefix" in section else "",
        given=_assignments(section, "arguments", declared),
        defaults=_assignments(section, "defaults", declared),
        conditions=conditions_of(section, own),
        choices={argument.name: argument.choices for argument in own},
    )
    section.finish()
    return include


def _assignments(
    section: YamlSection, key: str, declared: Mapping[str, Argument]
) -> dict[str, Value]:
    inner = section.optional_section(key)
    if inner is None:
        return {}
    found = {}
    for name, value in inner.items():
        if name not in declared:
            raise inner.error(name, value, f"no such argument; one of: {', '.join(declared)}")
        argument = declared[name]
        is_filled = isinstance(value, str) and ARGUMENT.search(value) and key == "arguments"
        if not (fits(argument, value) or is_filled):
            choices = f", one of {', '.join(argument.choices)}" if argument.choices else ""
            raise inner.error(name, value, f"a value of type {argument.type}{choices}")
        found[name] = value
    return found
