"""YAML as text: bounded reading of what people give, writing of files that people read."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator, Mapping
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.constructor import RoundTripConstructor
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent, MappingStartEvent, ScalarEvent, SequenceStartEvent
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import RoundTripRepresenter

from cmp_tactile_processing.errors import InputError, found_text, printable, shortened

# Far more than a scene has; an alias counts as all that it stands for.
MAX_NODES = 30_000
MAX_DEPTH = 40
# Far more than a float has; Python itself refuses to convert more than 4300.
MAX_DIGITS = 1000
LINE_WIDTH = 100

# Unquoted words and numbers as in YAML 1.2.
WORDS = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)")
# What readers of YAML 1.1 and 1.2 take for different numbers: 0512 is 330 for some.
AMBIGUOUS = re.compile(
    r"[-+]?(0[0-9]+|0[bBoOxX][0-9a-fA-F_]+|[0-9]+_[0-9_]*(\.[0-9_]*)?([eE][-+]?[0-9]+)?"
    r"|[0-9_]+(:[0-5]?[0-9])+(\.[0-9_]*)?)"
)
FLOAT = re.compile(
    r"[-+]?((\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|\.(inf|Inf|INF))|\.(nan|NaN|NAN)"
)
# A text that needs no quotes, unless readers of YAML 1.1 take it for a boolean or for nothing.
PLAIN_TEXT = re.compile(
    r"(?!(?:y|n|yes|no|on|off|true|false|null)$)[a-z_][\w.-]*", re.ASCII | re.IGNORECASE
)


def yaml_value(text: str) -> Any:
    """A value as it would stand in a file; InputError where it cannot."""
    return yaml_content(Path("value"), text)[0]


def yaml_content(path: Path, text: str) -> tuple[Any, dict[str, int]]:
    """The document in a text of the file, and the line of each key path, from 1.

    It is of plain mappings, lists, texts, numbers, booleans and None.
    Raises InputError, naming file, line and key path, for what is not YAML or beyond the
    bounds.
    """
    reader = _Reader(path, text)
    try:
        return reader.content(), reader.lines
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else text.count("\n") + 1
        problem = ": ".join(part for part in (error.context, error.problem) if part)
    except YAMLError as error:
        # Of a character that no YAML file may have.
        line = text.count("\n", 0, getattr(error, "position", 0)) + 1
        problem = f"found the character {getattr(error, 'character', 0):#x}, expected text"
    where = f"{reader.key_path}: " if reader.key_path else ""
    msg = f"{path}:{line}: {where}not a YAML file: {problem}"
    raise InputError(printable(" ".join(msg.split())))


class _Reader:
    """Makes the content of one document of the parser's events, within the bounds.

    lines: of the key paths, from 1.  key_path: of what is read now.
    """

    def __init__(self, path: Path, text: str) -> None:
        self.lines: dict[str, int] = {}
        self.key_path = ""
        self._path = path
        self._events: Iterator[Any] = YAML(typ="safe", pure=True).parse(text)
        self._anchored: dict[str, tuple[Any, int]] = {}
        self._nodes = 0

    def content(self) -> Any:
        """The document; None for an empty one."""
        for event in self._events:
            if isinstance(event, (AliasEvent, ScalarEvent, SequenceStartEvent, MappingStartEvent)):
                if self.lines:
                    raise self._refused("a second document", "one document")
                content = self._value(event, "", 0)
        return content if self.lines else None

    def _value(self, event: Any, key_path: str, depth: int) -> Any:
        self.key_path = key_path
        self.lines.setdefault(key_path, event.start_mark.line + 1)
        if depth > MAX_DEPTH:
            raise self._refused("more nested levels", f"at most {MAX_DEPTH} nested levels")
        if isinstance(event, AliasEvent):
            if event.anchor not in self._anchored:
                raise self._refused(f"an alias of no value before it, *{event.anchor}", "a value")
            value, size = self._anchored[event.anchor]
            self._count(size)
            return value
        if event.tag is not None:
            tag = event.tag.replace("tag:yaml.org,2002:", "!!")
            raise self._refused(f"the tag {tag}", "a value without a tag")
        before = self._nodes
        self._count(1)
        if isinstance(event, ScalarEvent):
            value = self._scalar(event.value) if event.implicit[0] else event.value
        elif isinstance(event, SequenceStartEvent):
            value = [
                self._value(item, f"{key_path}[{number}]", depth + 1)
                for number, item in enumerate(self._until_end())
            ]
        else:
            value = self._mapping(key_path, depth)
        if event.anchor:
            self._anchored[event.anchor] = value, self._nodes - before
        return value

    def _mapping(self, key_path: str, depth: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for event in self._until_end():
            self.key_path = key_path
            if not isinstance(event, ScalarEvent):
                raise self._refused("a key that is a list or a mapping", "a plain word")
            key = str(event.value)
            if key == "<<" and event.implicit[0]:
                raise self._refused("a merge key '<<'", "the keys themselves")
            if key in found:
                raise self._refused(f"a duplicate key {found_text(key)}", "each key once")
            below = f"{key_path}.{shortened(key)}".lstrip(".")
            self.lines[below] = event.start_mark.line + 1
            found[key] = self._value(next(self._events), below, depth + 1)
        return found

    def _until_end(self) -> Iterator[Any]:
        for event in self._events:
            if type(event).__name__ in ("MappingEndEvent", "SequenceEndEvent"):
                return
            yield event

    def _scalar(self, text: str) -> Any:
        if text in WORDS:
            return WORDS[text]
        if INTEGER.fullmatch(text):
            if len(text) > MAX_DIGITS:
                raise self._refused(f"{len(text)} digits", f"at most {MAX_DIGITS}")
            return int(text)
        if AMBIGUOUS.fullmatch(text):
            expected = "a decimal number, as 512 or 0.5, or a text in quotes"
            raise self._refused(found_text(text), expected)
        if not FLOAT.fullmatch(text):
            return text
        # Python writes infinity and NaN without the point.
        number = float(text.replace(".", "") if text[-1] in "fFnN" else text)
        if math.isinf(number) and text[-1] not in "fF":
            raise self._refused(found_text(text), f"a number up to {sys.float_info.max:.2g}")
        return number

    def _count(self, size: int) -> None:
        self._nodes += size
        if self._nodes > MAX_NODES:
            raise self._refused("too much", f"at most {MAX_NODES} values in a file")

    def _refused(self, found: str, expected: str) -> InputError:
        line = self.lines.get(self.key_path, 1)
        where = self.key_path or "top level"
        msg = f"{self._path}:{line}: {where}: found {found}, expected {expected}"
        return InputError(printable(msg))


class _Number(str):
    """A number as it is written."""

    __slots__ = ()


class _Constructor(RoundTripConstructor):
    """Leaves numbers as they are written."""


class _Representer(RoundTripRepresenter):
    """Writes what readers of YAML 1.1 and 1.2 take for the same; no anchors."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002  the base class has it
        """Always."""
        return True

    def text(self, text: str) -> Any:
        """Plain where it is a word that means nothing else."""
        style = None if PLAIN_TEXT.fullmatch(text) else '"'
        return self.represent_scalar("tag:yaml.org,2002:str", text, style=style)

    def number(self, text: str) -> Any:
        """As it is written."""
        tag = self.serializer.resolver.resolve(ScalarNode, str(text), (True, False))
        return self.represent_scalar(tag, str(text))


for _kind in ("float", "int"):
    _Constructor.add_constructor(
        f"tag:yaml.org,2002:{_kind}", lambda _, node: _Number(str(node.value))
    )
_Representer.add_representer(str, _Representer.text)
_Representer.add_representer(tuple, _Representer.represent_list)
_Representer.add_representer(float, lambda writer, value: writer.number(yaml_number(value)))
_Representer.add_representer(_Number, _Representer.number)


def dump_yaml(mapping: Mapping[str, Any]) -> str:
    """A mapping as a file that `read_yaml` reads back; innermost lists and mappings on one line."""
    return _dumped(_yaml(), dict(mapping))


def updated_yaml(text: str, before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """The text of a file with other values; what stays the same keeps its layout and comments.

    The comment behind a value that changes is left out.
    before, after: what the file means, and is to mean.
    """
    yaml = _yaml()
    document = yaml.load(text)
    _update(document, before, after)
    return _dumped(yaml, document)


def _yaml() -> YAML:
    yaml = YAML()
    yaml.Constructor, yaml.Representer = _Constructor, _Representer
    yaml.default_flow_style = None
    yaml.preserve_quotes = True
    yaml.width = LINE_WIDTH
    yaml.indent(mapping=2, sequence=4, offset=2)
    return yaml


def _dumped(yaml: YAML, document: Any) -> str:
    written = StringIO()
    yaml.dump(document, written)
    return written.getvalue()


def _update(document: Any, before: Any, after: Any) -> None:
    """Values of a mapping or list of a document that differ."""
    if isinstance(after, dict):
        for key in before.keys() - after.keys():
            document.pop(key, None)
    for key, value in after.items() if isinstance(after, dict) else enumerate(after):
        old = before[key] if isinstance(before, list) else before.get(key)
        there = isinstance(document, list) or key in document
        if there and _have_same_places(old, value):
            _update(document[key], old, value)
        elif old != value or not there:
            document[key] = value
        if old != value:
            _drop_comment(document, key)


def _have_same_places(old: Any, value: Any) -> bool:
    if isinstance(old, list) and isinstance(value, list):
        return len(old) == len(value)
    return isinstance(old, dict) and isinstance(value, dict)


def _drop_comment(document: Any, key: Any) -> None:
    """The comment behind the value of a key, with the lines that go on in its column."""
    for token in document.ca.items.get(key, ()):
        if token is not None and not isinstance(token, list):
            _, *below = token.value.split("\n")
            while below and below[0].find("#") == token.start_mark.column:
                del below[0]
            # What is left is about the next key.
            token.value = "\n" + "\n".join(below)


def yaml_number(value: float) -> str:
    """The shortest decimal that reads back as the same float, with the point YAML 1.1 asks for."""
    number = float(value)
    if math.isnan(number):
        return ".nan"
    if math.isinf(number):
        return ".inf" if number > 0 else "-.inf"
    mantissa, exponent, power = repr(number).partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}{exponent}{power}"
