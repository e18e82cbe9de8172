"""Checked reading of YAML mappings: every error names file, key path, found and expected."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from cmp_tactile_processing.errors import DescriptionError

__all__ = ["YamlSection", "parse_yaml", "read_yaml"]

MAX_FILE_BYTES = 1_000_000
_MISSING = object()


class _Loader(yaml.SafeLoader):
    """SafeLoader that refuses duplicate keys; reads 5e5 as a number and dates as text.

    So does YAML 1.2.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                msg = "a key that is no plain word"
                raise yaml.constructor.ConstructorError(None, None, msg, key_node.start_mark)
            if key_node.value in seen:
                msg = f"duplicate key '{key_node.value}'"
                raise yaml.constructor.ConstructorError(None, None, msg, key_node.start_mark)
            seen.add(key_node.value)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)
_Loader.yaml_implicit_resolvers = {
    first: [item for item in resolvers if item[0] != "tag:yaml.org,2002:timestamp"]
    for first, resolvers in _Loader.yaml_implicit_resolvers.items()
}


def read_yaml(path: Path) -> YamlSection:
    """The top-level mapping of a YAML file.

    Raises DescriptionError for a file that is absent, too large, not YAML or not a mapping.
    """
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            msg = f"{path}: found {path.stat().st_size} bytes, expected at most {MAX_FILE_BYTES}"
            raise DescriptionError(msg)
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        msg = f"{path}: cannot be read: {error}"
        raise DescriptionError(msg) from None
    return parse_yaml(path, text)


def parse_yaml(path: Path, text: str) -> YamlSection:
    """The top-level mapping of a text that is, or is to be, in the file.

    Raises DescriptionError, naming the file, for what is not YAML or not a mapping.
    """
    try:
        content = yaml.load(text, Loader=_Loader)  # noqa: S506
    except (yaml.YAMLError, RecursionError) as error:
        msg = f"{path}: not a YAML file: {' '.join(str(error).split())}"
        raise DescriptionError(msg) from None
    return YamlSection(path, "", content)


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

    def error(self, key: str, found: object, expected: str) -> DescriptionError:
        """The error for a key of this section."""
        where = ".".join(part for part in (self._key_path, key) if part) or "top level"
        what = "nothing" if found is _MISSING else _shorten(found)
        return DescriptionError(f"{self._path}: {where}: found {what}, expected {expected}")

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
                allowed = ", ".join(sorted(self._read | self._asked))
                raise self.error(str(key), self._content[key], f"no such key; allowed: {allowed}")

    def raw(self, key: str, expected: str = "a value") -> Any:
        """The value as YAML gave it."""
        self._read.add(key)
        value = self._content.get(key, _MISSING)
        if value is _MISSING:
            raise self.error(key, value, expected)
        return value

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


def _shorten(value: object, length: int = 80) -> str:
    text = repr(value)
    return text if len(text) <= length else text[: length - 3] + "..."
