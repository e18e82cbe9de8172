"""Checked reading of YAML mappings: every error names file, key path, found and expected."""

from __future__ import annotations

import math
import re
import reprlib
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from typing import Any

import yaml
from yaml.composer import Composer
from yaml.parser import Parser
from yaml.reader import Reader, ReaderError
from yaml.resolver import Resolver
from yaml.scanner import Scanner

from cmp_tactile_processing.errors import DescriptionError, printable

__all__ = [
    "YamlSection",
    "did_you_mean",
    "dump_yaml",
    "found_text",
    "meant",
    "parse_yaml",
    "read_yaml",
    "yaml_value",
]

MAX_FILE_BYTES = 1_000_000
# Far more than a scene has; an alias counts as all that it stands for.
MAX_NODES = 30_000
MAX_DEPTH = 40
# Far more than a float has; Python itself refuses to convert more than 4300.
MAX_DIGITS = 1000
# How alike a misspelt word is to the one that is meant.
ALIKE = 0.7
# What people give by mistake instead of the unit that is asked for, as factors.
OTHER_UNITS = {"m": (1e-3, 1e-6), "Pa": (1e3, 1e6)}
LAYOUT: Mapping[str, Any] = {"sort_keys": False, "width": 100, "allow_unicode": True}
_MISSING = object()

_TAG = "tag:yaml.org,2002:"
# What YAML 1.1 takes for a number and people do not: 0512 is 330, 1:30 is 90, 1_0 is 10.
_AMBIGUOUS_TAG = "!ambiguous number"
_NUMBERS = (
    (_TAG + "int", r"[-+]?(0|[1-9][0-9]*)"),
    (_AMBIGUOUS_TAG, r"[-+]?0([0-9]+|[bB][01_]+|[oO][0-7_]+|[xX][0-9a-fA-F_]+)"),
    (_AMBIGUOUS_TAG, r"[-+]?[0-9]+_[0-9_]*(\.[0-9_]*)?([eE][-+]?[0-9]+)?"),
    (_AMBIGUOUS_TAG, r"[-+]?[0-9_]+(:[0-5]?[0-9])+(\.[0-9_]*)?"),
    (
        _TAG + "float",
        r"[-+]?((\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|\.(inf|Inf|INF))|\.(nan|NaN|NAN)",
    ),
)
_KEPT_TAGS = {_TAG + kind for kind in ("bool", "null", "merge")}
_BOOLEANS = yaml.SafeLoader.bool_values


def _resolvers() -> dict[str, list[tuple[str, re.Pattern[str]]]]:
    """Meanings of unquoted words by their first letter: numbers as in YAML 1.2, dates are texts."""
    found = {
        first: [item for item in items if item[0] in _KEPT_TAGS]
        for first, items in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    numbers = [(tag, re.compile(f"^(?:{pattern})$")) for tag, pattern in _NUMBERS]
    for first in "-+.0123456789":
        found[first] = [*found.get(first, ()), *numbers]
    return found


class _PythonParser(Reader, Scanner, Parser):
    """The parser of a PyYAML that was built without libyaml; eight times slower."""

    def __init__(self, text: str) -> None:
        Reader.__init__(self, text)
        Scanner.__init__(self)
        Parser.__init__(self)


try:
    from yaml.cyaml import CParser  # type: ignore[attr-defined]
except ImportError:
    _Parser: Any = _PythonParser
else:
    _Parser = CParser


class _Loader(Composer, _Parser, Resolver):  # type: ignore[misc]
    """Reads one document within bounds, and knows of what goes wrong under which key it does.

    It makes nothing but mappings, lists, texts, numbers, booleans and None.
    """

    yaml_implicit_resolvers = _resolvers()

    def __init__(self, path: Path, text: str) -> None:
        _Parser.__init__(self, text)
        Composer.__init__(self)
        Resolver.__init__(self)
        self.key_path = ""
        self._path = path
        self._depth = self._nodes = 0
        self._sizes: dict[str, int] = {}

    def content(self) -> Any:
        """The document; DescriptionError for what is refused, YAMLError for what is not YAML."""
        node = self.get_single_node()
        return None if node is None else self._value(node, "", 0)

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """As the base class; bounded, and without tags."""
        outer = self.key_path
        if index is not None:
            name = index.value if isinstance(index, yaml.ScalarNode) else index
            self.key_path = _below(outer, name)
        event = self.peek_event()
        size = 1
        if isinstance(event, yaml.AliasEvent) and event.anchor in self.anchors:
            if event.anchor not in self._sizes:
                raise self._refused(f"an alias of what it lies in, *{event.anchor}", "none")
            size = self._sizes[event.anchor]
        if getattr(event, "tag", None) is not None:
            raise self._refused(f"the tag {event.tag.replace(_TAG, '!!')}", "a value without a tag")
        before, self._nodes = self._nodes, self._nodes + size
        if self._nodes > MAX_NODES:
            raise self._refused("too much", f"at most {MAX_NODES} values in a file")
        self._depth += 1
        self._check_depth(self._depth)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if event.anchor and not isinstance(event, yaml.AliasEvent):
            self._sizes[event.anchor] = self._nodes - before
        self.key_path = outer
        return node

    def _value(self, node: yaml.Node, key_path: str, depth: int) -> Any:
        self.key_path = key_path
        self._check_depth(depth)
        if isinstance(node, yaml.ScalarNode):
            return self._scalar(node)
        if isinstance(node, yaml.SequenceNode):
            return [
                self._value(item, _below(key_path, number), depth + 1)
                for number, item in enumerate(node.value)
            ]
        found: dict[str, Any] = {}
        for key_node, item in node.value:
            self.key_path = key_path
            key = self._key(key_node)
            if key in found:
                raise self._refused(f"a duplicate key {found_text(key)}", "each key once")
            found[key] = self._value(item, _below(key_path, key), depth + 1)
        return found

    def _key(self, node: yaml.Node) -> str:
        if not isinstance(node, yaml.ScalarNode):
            raise self._refused("a key that is a list or a mapping", "a plain word")
        if node.tag == _TAG + "merge":
            raise self._refused("a merge key '<<'", "the keys themselves")
        return str(node.value)

    def _scalar(self, node: yaml.ScalarNode) -> Any:
        text, kind = str(node.value), node.tag.removeprefix(_TAG)
        if kind == _AMBIGUOUS_TAG:
            expected = "a decimal number, as 512 or 0.5, or a text in quotes"
            raise self._refused(found_text(text), expected)
        if kind == "int":
            if len(text) > MAX_DIGITS:
                raise self._refused(f"{len(text)} digits", f"at most {MAX_DIGITS}")
            return int(text)
        if kind == "float":
            # Python writes infinity and NaN without the point.
            number = float(text.replace(".", "") if text[-1] in "fFnN" else text)
            if math.isinf(number) and text[-1] not in "fF":
                raise self._refused(found_text(text), f"a number up to {sys.float_info.max:.2g}")
            return number
        if kind == "bool":
            return _BOOLEANS[text.lower()]
        return None if kind == "null" else text

    def _check_depth(self, depth: int) -> None:
        if depth > MAX_DEPTH:
            raise self._refused("one more level", f"at most {MAX_DEPTH} levels in each other")

    def _refused(self, found: str, expected: str) -> DescriptionError:
        where = self.key_path or "top level"
        msg = f"{self._path}: {where}: found {found}, expected {expected}"
        return DescriptionError(printable(msg))


class _Dumper(yaml.SafeDumper):
    """Puts quotes around what the loader would not read as a text."""

    yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002  the base class has it
        """Always: no anchors in files that people read."""
        return True


def dump_yaml(mapping: Mapping[str, Any]) -> str:
    """A mapping as a file that `read_yaml` reads back."""
    text: str = yaml.dump(dict(mapping), Dumper=_Dumper, **LAYOUT)
    return text


def read_yaml(path: Path) -> YamlSection:
    """The top-level mapping of a YAML file.

    Raises DescriptionError for a file that is absent, too large, not YAML or not a mapping.
    """
    try:
        if path.exists() and not path.is_file():
            msg = f"{path}: found no regular file, expected a YAML file"
            raise DescriptionError(msg)
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        msg = f"{path}: cannot be read: {error.strerror or error}"
        raise DescriptionError(msg) from None
    if len(data) > MAX_FILE_BYTES:
        msg = f"{path}: found a larger file, expected at most {MAX_FILE_BYTES} bytes"
        raise DescriptionError(msg)
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        msg = f"{path}: line {line}: found the byte {data[error.start]:#x}, expected UTF-8 text"
        raise DescriptionError(msg) from None
    return parse_yaml(path, text)


def parse_yaml(path: Path, text: str) -> YamlSection:
    """The top-level mapping of a text that is, or is to be, in the file.

    Raises DescriptionError, naming the file, for what is not YAML or not a mapping.
    """
    return YamlSection(path, "", _load(path, text))


def yaml_value(text: str) -> Any:
    """A value as it would stand in a file; DescriptionError where it cannot."""
    return _load(Path("value"), text)


def _load(path: Path, text: str) -> Any:
    loader = None
    try:
        loader = _Loader(path, text)
        return loader.content()
    except ReaderError as error:
        line = text[: error.position].count("\n") + 1
        msg = (
            f"{path}: line {line}: not a YAML file: found the character {error.character:#x}, "
            "expected text"
        )
    except UnicodeEncodeError:
        msg = f"{path}: not a YAML file: found bytes that are not UTF-8, expected text"
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"line {mark.line + 1}, column {mark.column + 1}" if mark else "its end"
        where = (loader.key_path if loader else "") or "top level"
        problem = ": ".join(part for part in (error.context, error.problem) if part)
        msg = f"{path}: {printable(where)}: not a YAML file: {place}: {' '.join(problem.split())}"
    raise DescriptionError(msg)


def _below(key_path: str, key: str | int) -> str:
    if isinstance(key, int):
        return f"{key_path}[{key}]"
    return f"{key_path}.{_cut(str(key))}".lstrip(".")


class YamlSection:
    """One mapping of a file; remembers which keys were read so that `finish` can name the rest."""

    def __init__(self, path: Path, key_path: str, content: object) -> None:
        self._path = path
        self._key_path = key_path
        if not isinstance(content, dict):
            raise self.error("", content, "a mapping")
        self._content = content
        self._read: set[str] = set()
        self._asked: set[str] = set()

    @property
    def path(self) -> Path:
        """The file."""
        return self._path

    def error(self, key: str, found: object, expected: str) -> DescriptionError:
        """The error for a key of this section."""
        where = ".".join(part for part in (self._key_path, key) if part) or "top level"
        what = "nothing" if found is _MISSING else found_text(found)
        msg = f"{self._path}: {where}: found {what}, expected {expected}"
        return DescriptionError(printable(msg))

    def refused(self, problem: Exception) -> DescriptionError:
        """The error for values whose problem names section and key itself."""
        return DescriptionError(f"{self._path}: {problem}")

    def __contains__(self, key: str) -> bool:
        self._asked.add(key)
        return key in self._content

    def finish(self) -> None:
        """Raise for keys that nobody asked for."""
        for key in self._content:
            if key not in self._read:
                allowed = sorted(self._read | self._asked)
                expected = f"no such key; allowed: {', '.join(allowed)}{did_you_mean(key, allowed)}"
                raise self.error(key, self._content[key], expected)

    def raw(self, key: str, expected: str = "a value") -> Any:
        """The value as YAML gave it."""
        self._read.add(key)
        value = self._content.get(key, _MISSING)
        if value is _MISSING:
            raise self.error(key, value, expected + self._near_miss(key))
        return value

    def _near_miss(self, key: str) -> str:
        """A key that is there and may be meant for the one that is missing."""
        others = [name for name in self._content if name not in self._read | self._asked]
        near = _close(key, others)
        return f"; found {found_text(near)}: did you mean '{key}'?" if near else ""

    def section(self, key: str) -> YamlSection:
        """A mapping below this one."""
        value = self.raw(key, "a mapping")
        return YamlSection(self._path, f"{self._key_path}.{key}".lstrip("."), value)

    def optional_section(self, key: str) -> YamlSection | None:
        """A mapping below this one, or None where the key is absent."""
        self._read.add(key)
        return self.section(key) if key in self._content else None

    def sections(self, key: str) -> Iterator[YamlSection]:
        """The mappings of a list; none where the key is absent."""
        self._read.add(key)
        value = self._content.get(key, [])
        if not isinstance(value, list):
            raise self.error(key, value, "a list of mappings")
        for number, item in enumerate(value):
            yield YamlSection(self._path, f"{self._key_path}.{key}[{number}]".lstrip("."), item)

    def items(self) -> Iterator[tuple[str, Any]]:
        """All keys with their values, each marked as read."""
        for key, value in self._content.items():
            self._read.add(str(key))
            yield str(key), value

    def text(self, key: str) -> str:
        """A non-empty string."""
        value = self.raw(key, "a text")
        if not isinstance(value, str) or not value:
            raise self.error(key, value, "a text")
        return value

    def choice(self, key: str, choices: Sequence[str]) -> str:
        """One of a few words."""
        expected = "one of " + ", ".join(choices)
        value = self.raw(key, expected)
        if value not in choices or not isinstance(value, str):
            raise self.error(key, value, expected)
        return value

    def number(self, key: str, low: float = -math.inf, high: float = math.inf) -> float:
        """A finite number, low <= number <= high."""
        expected = "a number" + _range_text(low, high)
        value = self.raw(key, expected)
        if not _is_number(value) or not low <= value <= high:
            raise self.error(key, value, expected)
        return float(value)

    def quantity(self, key: str, unit: str, low: float, high: float) -> float:
        """A number of that unit, low <= number <= high; names what another unit's may mean."""
        expected = f"a number from {low:g} to {high:g} {unit}"
        value = self.raw(key, expected)
        if not _is_number(value) or not low <= value <= high:
            raise self.error(key, value, expected + meant([value], unit, low, high))
        return float(value)

    def quantities(
        self, key: str, unit: str, limits: Sequence[tuple[float, float]]
    ) -> tuple[float, ...]:
        """A list of numbers of that unit, each within its limits."""
        values = self.numbers(key, len(limits))
        for number, (value, (low, high)) in enumerate(zip(values, limits, strict=True)):
            if not low <= value <= high:
                expected = f"a number from {low:g} to {high:g} {unit}"
                hint = meant([value], unit, low, high)
                raise self.error(f"{key}[{number}]", self._content[key][number], expected + hint)
        return values

    def positive(self, key: str, high: float = math.inf) -> float:
        """A finite number, 0 < number <= high."""
        expected = "a number above 0" + ("" if math.isinf(high) else f", at most {high:g}")
        value = self.raw(key, expected)
        if not _is_number(value) or not 0 < value <= high:
            raise self.error(key, value, expected)
        return float(value)

    def integer(self, key: str, low: int, high: int) -> int:
        """A whole number, low <= number <= high."""
        expected = "a whole number" + _range_text(low, high)
        value = self.raw(key, expected)
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise self.error(key, value, expected)
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """A list of non-empty strings; it may be empty."""
        value = self.raw(key, "a list of texts")
        if not isinstance(value, list) or not all(isinstance(v, str) and v for v in value):
            raise self.error(key, value, "a list of texts")
        return tuple(value)

    def numbers(self, key: str, length: int) -> tuple[float, ...]:
        """A list of finite numbers of the given length."""
        expected = f"a list of {length} numbers"
        value = self.raw(key, expected)
        if not isinstance(value, list) or len(value) != length or not all(map(_is_number, value)):
            raise self.error(key, value, expected)
        return tuple(float(item) for item in value)

    def number_rows(self, key: str, rows: int, cols: int) -> tuple[tuple[float, ...], ...]:
        """A list of `rows` lists of `cols` finite numbers each."""
        expected = f"{rows} lists of {cols} numbers"
        value = self.raw(key, expected)
        good = isinstance(value, list) and len(value) == rows
        for row in value if good else ():
            good &= isinstance(row, list) and len(row) == cols and all(map(_is_number, row))
        if not good:
            raise self.error(key, value, expected)
        return tuple(tuple(float(item) for item in row) for row in value)


def _is_number(value: object) -> bool:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return False
    return abs(value) <= sys.float_info.max


def _range_text(low: float, high: float) -> str:
    if math.isinf(low) and math.isinf(high):
        return ""
    if math.isinf(high):
        return f" of at least {low:g}"
    return f" from {low:g} to {high:g}"


def meant(values: Sequence[Any], unit: str, low: float, high: float) -> str:
    """What is probably meant by values that are out of range: as they are in a usual other unit.

    Empty where that does not bring all of them into the range.
    """
    if not all(map(_is_number, values)):
        return ""
    for factor in OTHER_UNITS.get(unit, ()):
        scaled = [float(f"{value * factor:.12g}") for value in values]
        if any(values) and all(low <= value <= high for value in scaled):
            text = f"{scaled[0]:.12g}" if len(scaled) == 1 else f"{scaled}"
            return f": did you mean {text}?"
    return ""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A question after a semicolon; empty where no known word is like it."""
    near = _close(word, known)
    return f"; did you mean '{near}'?" if near else ""


def _close(word: str, known: Iterable[str]) -> str:
    by_lower = {name.lower(): name for name in known}
    near = get_close_matches(word[:100].lower(), by_lower, n=1, cutoff=ALIKE)
    return by_lower[near[0]] if near else ""


def found_text(value: object) -> str:
    """A value as an error shows it: cut before it is written, whatever its size."""
    return _cut(_REPR.repr(value))


def _cut(text: str, length: int = 80) -> str:
    return text if len(text) <= length else text[: length - 3] + "..."


class _Repr(reprlib.Repr):
    """Of a mapping the first keys in their order."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlist = self.maxtuple = self.maxdict = 12
        self.maxlevel = 4
        self.maxstring = self.maxother = self.maxlong = 200

    def repr_str(self, x: str, level: int) -> str:  # noqa: ARG002  the base class has it
        return repr(x[: self.maxstring])

    def repr_dict(self, x: dict[Any, Any], level: int) -> str:
        if level <= 0:
            return "{...}"
        first = islice(x.items(), self.maxdict)
        items = [f"{self.repr1(k, level - 1)}: {self.repr1(v, level - 1)}" for k, v in first]
        return "{" + ", ".join(items) + "}"


_REPR = _Repr()
