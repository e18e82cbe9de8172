"""YAML files read into dataclasses by pydantic, all that is wrong with them named at once.

A key is declared where its value lives: as a field of a `Part`, with what the functions below
return as metadata.  Errors and JSON schema are made from that.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache, reduce
from operator import getitem
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args

from cmp_tactile_processing.cache.files import expanded_path
from cmp_tactile_processing.errors import (
    InputError,
    RefusedValueError,
    found_text,
    printable,
    shortened,
)
from cmp_tactile_processing.sensor.yaml_text import yaml_content

MAX_FILE_BYTES = 1_000_000
# How alike a misspelt word is to the one that is meant.
MIN_SPELLING_SIMILARITY = 0.7
# What people give by mistake instead of the unit that is asked for, as factors.
OTHER_UNITS = {"m": (1e-3, 1e-6), "Pa": (1e3, 1e6)}
NOTHING = object()
# Within the places of pydantic's errors they say which part of a union was read.
TAGS = ("<first>", "<second>")
# There they say that the key itself is wrong.
WRONG_KEY = "[key]"
KINDS = {
    "array": "a list",
    "boolean": "true or false",
    "integer": "a whole number",
    "number": "a number",
    "object": "a mapping",
    "string": "a text",
}

T = TypeVar("T")
Key = str | int


class Part:
    """Base of dataclasses that a file is read into.  Their values have exactly the types declared.

    `checked` is called with one whose fields are right: for what several fields must be together.
    """

    __pydantic_config__: ClassVar[Any] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}

    def checked(self) -> Any:
        """The part itself, or one to use in its place; RefusedValueError for one that is wrong."""
        return self

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> Any:
        # pydantic is loaded where a file is read.
        from pydantic_core.core_schema import no_info_after_validator_function

        return no_info_after_validator_function(cls.checked, handler(source))


@dataclass(frozen=True)
class Check:
    """Of an annotated type: what makes the value of what a file says, RefusedValueError if wrong.

    kind: that the file says, where it is another than the type.
    """

    function: Callable[[Any], Any]
    kind: Any = None

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core.core_schema import no_info_after_validator_function

        schema = handler(source) if self.kind is None else handler.generate_schema(self.kind)
        return no_info_after_validator_function(self.function, schema)


@dataclass(frozen=True)
class OrElse:
    """Of an annotated type: the value for a file without the key; one that is written has it."""

    default: Any

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core.core_schema import with_default_schema

        return with_default_schema(handler(source), default=self.default)


@dataclass(frozen=True)
class Limits:
    """Of a number within a list or mapping: low <= number <= high."""

    low: float
    high: float

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return {**handler(source), "ge": self.low, "le": self.high}


@dataclass(frozen=True)
class SecondWith:
    """Of a union of two parts: it is the second where a file has the key."""

    key: str

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core.core_schema import tagged_union_schema

        choices = dict(zip(TAGS, map(handler.generate_schema, get_args(source)), strict=True))
        return tagged_union_schema(choices, discriminator=self._tag)

    def _tag(self, value: Any) -> str:
        return TAGS[isinstance(value, dict) and self.key in value]


class NotInFile:
    """Of an annotated type: a file has no such key."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core.core_schema import no_info_after_validator_function

        return no_info_after_validator_function(self._refuse, handler(source))

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        from pydantic_core import PydanticOmit

        raise PydanticOmit

    def _refuse(self, _: Any) -> Any:
        raise RefusedValueError("no such key")


def number(low: float = -math.inf, high: float = math.inf, unit: str = "") -> dict[str, Any]:
    """A finite or whole number, low <= number <= high."""
    limits = {"ge": low, "le": high}
    return {
        **{name: limit for name, limit in limits.items() if math.isfinite(limit)},
        "json_schema_extra": {"unit": unit},
    }


def positive(high: float = math.inf, unit: str = "") -> dict[str, Any]:
    """A finite number, 0 < number <= high."""
    return {**number(high=high, unit=unit), "gt": 0}


def choice(*words: str) -> dict[str, Any]:
    """One of the words."""
    pattern = "|".join(map(re.escape, words))
    return {"pattern": f"^({pattern})$", "json_schema_extra": {"enum": list(words)}}


def text() -> dict[str, Any]:
    """A text that is not empty."""
    return {"min_length": 1}


def named_file(name_or_path: str, kind: str, packaged: Mapping[str, Path]) -> Path:
    """A file by its path, or one that comes with a package by its name.

    kind: such as "recipe".  Raises InputError where there is neither, with a name like it.
    """
    path = packaged.get(name_or_path) or expanded_path(name_or_path)
    if not path.is_file():
        msg = f"{name_or_path}: found no such {kind}, expected a file or one of "
        msg += ", ".join(packaged) + did_you_mean(name_or_path, packaged)
        raise InputError(msg)
    return path


def read_yaml(path: Path) -> YamlFile:
    """A file of a mapping.

    Raises InputError for one that is absent, too large, not YAML or not a mapping.
    """
    try:
        if path.exists() and not path.is_file():
            msg = f"{path}: found no regular file, expected a YAML file"
            raise InputError(msg)
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        msg = f"{path}: cannot be read: {error.strerror or error}"
        raise InputError(msg) from None
    if len(data) > MAX_FILE_BYTES:
        msg = f"{path}: found a larger file, expected at most {MAX_FILE_BYTES} bytes"
        raise InputError(msg)
    try:
        return parse_yaml(path, data.decode("utf-8"))
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        msg = f"{path}:{line}: found the byte {data[error.start]:#x}, expected UTF-8 text"
        raise InputError(msg) from None


def parse_yaml(path: Path, text: str) -> YamlFile:
    """A text that is, or is to be, in the file; as `read_yaml`."""
    content, lines = yaml_content(path, text)
    file = YamlFile(path, content, lines, text)
    if not isinstance(content, dict):
        raise file.error("", content, "a mapping")
    return file


@dataclass(frozen=True)
class YamlFile:
    """What is in a file.  lines: of its key paths.  above: key path of the content in the file."""

    path: Path
    content: dict[str, Any]
    lines: Mapping[str, int]
    text: str = ""
    above: str = ""

    def read(self, kind: type[T], version: int = 0) -> T:
        """The dataclass that the file is; InputError with all that is wrong, a line each.

        version: of the format, which the file has to name, if not 0.
        """
        from pydantic import ValidationError

        content = self.content
        if version:
            self._check_version(version, kind)
            content = {key: value for key, value in content.items() if key != "version"}
        try:
            # Of JSON, pydantic makes tuples and dataclasses without converting anything else.
            value: T = _adapter(kind).validate_json(json.dumps(content))
        except ValidationError as error:
            schema = _adapter(kind).json_schema()
            problems = error.errors(include_url=False)
            text = "\n".join(self._problem(item, schema) for item in problems)
            raise InputError(text) from None
        return value

    def below(self, key: str) -> YamlFile:
        """The mapping of a key of the file; InputError where it is none."""
        content = self.content.get(key, NOTHING)
        if not isinstance(content, dict):
            raise self.error(key, content, "a mapping")
        return YamlFile(self.path, content, self.lines, above=key)

    def error(self, key: str, found: object, expected: str) -> InputError:
        """The error for the value of a key path; found: NOTHING where it is missing."""
        return InputError(self._line(key, found, expected))

    def _check_version(self, version: int, kind: type[Any]) -> None:
        found = self.content.get("version")
        if found is None:
            keys = shortened(", ".join(self.content) or "nothing")
            name = re.sub("([A-Z])", r" \1", kind.__name__).strip().lower()
            raise self.error("", keys, f"a {name} with version: {version}")
        if type(found) is not int or found != version:
            raise self.error("version", found, str(version))

    def _at(self, where: str) -> str:
        """The file, with the line of the key path or of what it is below, where that is known."""
        while where and where not in self.lines:
            where = where[: max(where.rfind("."), where.rfind("["), 0)]
        return f"{self.path}:{self.lines[where]}" if where in self.lines else f"{self.path}"

    def _path_of(self, key: str) -> str:
        return ".".join(part for part in (self.above, key) if part)

    def _line(self, key: str, found: object, expected: str) -> str:
        where = self._path_of(key)
        shown = "nothing" if found is NOTHING else found_text(found)
        text = f"{where or 'top level'}: found {shown}, expected {expected}"
        return printable(f"{self._at(where)}: {text}")

    def _problem(self, item: Any, schema: Any) -> str:
        """The line of one of pydantic's errors."""
        where = tuple(key for key in item["loc"] if key != WRONG_KEY)
        loc, found = tuple(key for key in where if key not in TAGS), item["input"]
        cause = item.get("ctx", {}).get("error")
        if isinstance(cause, RefusedValueError):
            loc += cause.key
            found = _value_at(self.content, loc) if cause.found is None else cause.found
            expected = cause.expected
        elif isinstance(cause, InputError):
            # It names the key, the value, and what is expected.
            return printable(f"{self._at(self._path_of(_key_path(loc)))}: {cause}")
        elif item["type"] == "unexpected_keyword_argument" or WRONG_KEY in item["loc"]:
            node = _schema_at(schema, where[:-1])
            allowed = node.get("propertyNames", {}).get("enum") or sorted(node["properties"])
            hint = did_you_mean(str(where[-1]), allowed)
            expected = f"no such key; allowed: {', '.join(allowed)}{hint}"
        else:
            found = NOTHING if item["type"] == "missing" else found
            expected = _expected(_schema_at(schema, item["loc"]), found) or item["msg"]
        return self._line(_key_path(loc), found, expected)


def file_schema(kind: type[Any], version: int) -> dict[str, Any]:
    """JSON schema (draft 2020-12) of a file that `YamlFile.read` reads, for editors."""
    schema = part_schema(kind)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **schema,
        "properties": {"version": {"const": version}, **schema["properties"]},
        "required": ["version", *schema["required"]],
    }


def part_schema(kind: type[Any]) -> dict[str, Any]:
    """JSON schema of a mapping that is read into the dataclass."""
    # The default of an unknown number is NaN, which JSON does not have.
    text = json.dumps(_adapter(kind).json_schema())
    schema: dict[str, Any] = json.loads(text, parse_constant=lambda _: None)
    return schema


def _new_adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


_adapter: Callable[[Any], Any] = lru_cache(_new_adapter)


def _key_path(loc: Sequence[Key]) -> str:
    parts = (f"[{key}]" if isinstance(key, int) else f".{shortened(key)}" for key in loc)
    return "".join(parts).lstrip(".")


def _value_at(content: Any, loc: Sequence[Key]) -> Any:
    try:
        return reduce(getitem, loc, content)
    except (KeyError, IndexError, TypeError):
        return NOTHING


def _schema_at(schema: Any, loc: Sequence[Key]) -> Any:
    """What the schema says of a key path; the unit of a list is that of its values."""
    node = schema
    for key in (*loc, None):
        node = {
            **node,
            **next((item for item in node.get("anyOf", ()) if item.get("type") != "null"), {}),
        }
        if "$ref" in node:
            node = schema["$defs"][node["$ref"].rpartition("/")[2]]
        if key is None:
            return node
        if key in TAGS:
            node = node["oneOf"][TAGS.index(key)]
            continue
        unit = {"unit": node.get("unit", "")}
        if isinstance(key, int):
            first = node.get("prefixItems", ())
            node = first[key] if key < len(first) else node.get("items", {})
        else:
            node = node.get("properties", {}).get(key) or node.get("additionalProperties") or {}
        node = {**unit, **node}
    return node


def _expected(node: Mapping[str, Any], found: Any) -> str:
    """What a part of a schema allows."""
    if "enum" in node:
        return "one of " + ", ".join(node["enum"])
    expected, unit = KINDS.get(node.get("type", ""), ""), node.get("unit", "")
    if node.get("type") == "array" and "minItems" in node:
        kind = KINDS.get(node["prefixItems"][0].get("type", ""), "a value")
        expected += f" of {node['minItems']}, each {kind}"
    low = node.get("minimum", -math.inf)
    high = node.get("maximum", math.inf)
    if "exclusiveMinimum" in node:
        expected += f" above {node['exclusiveMinimum']:g}"
        expected += f", at most {high:g}" if math.isfinite(high) else ""
    elif low == high:
        return f"{low:g}"
    elif math.isfinite(low):
        span = f" from {low:g} to {high:g}" if math.isfinite(high) else f" of at least {low:g}"
        expected += span
    return f"{expected} {unit}".strip() + meant([found], unit, low, high)


def _is_number(value: object) -> bool:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        return False
    return abs(value) <= sys.float_info.max


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
    by_lower = {name.lower(): name for name in known}
    near = get_close_matches(word[:100].lower(), by_lower, n=1, cutoff=MIN_SPELLING_SIMILARITY)
    return f"; did you mean '{by_lower[near[0]]}'?" if near else ""
