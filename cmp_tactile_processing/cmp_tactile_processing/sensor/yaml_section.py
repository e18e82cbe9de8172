"""Sections of a YAML file, and what their keys may hold, declared with the fields they make."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

from cmp_tactile_processing.errors import InputError, found_text, printable, shortened
from cmp_tactile_processing.sensor.yaml_text import yaml_content

MAX_FILE_BYTES = 1_000_000
# How alike a misspelt word is to the one that is meant.
MIN_SPELLING_SIMILARITY = 0.7
# What people give by mistake instead of the unit that is asked for, as factors.
OTHER_UNITS = {"m": (1e-3, 1e-6), "Pa": (1e3, 1e6)}
_MISSING = object()

Part = TypeVar("Part")
Metadata = Mapping[str, Any]


class MissingKeysError(InputError):
    """A file lacks keys.

    keys: for each of them its path, and that nothing was found and what is expected.
    """

    def __init__(self, path: Path, keys: Sequence[str]) -> None:
        self.keys = tuple(dict.fromkeys(keys))
        super().__init__(f"{path}: {'; '.join(self.keys)}")


def read_yaml(path: Path) -> YamlSection:
    """The top-level mapping of a YAML file.

    Raises InputError for a file that is absent, too large, not YAML or not a mapping.
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
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        msg = f"{path}:{line}: found the byte {data[error.start]:#x}, expected UTF-8 text"
        raise InputError(msg) from None
    return parse_yaml(path, text)


def parse_yaml(path: Path, text: str) -> YamlSection:
    """The top-level mapping of a text that is, or is to be, in the file.

    Raises InputError, naming the file, for what is not YAML or not a mapping.
    """
    content, lines = yaml_content(path, text)
    return YamlSection(path, "", content, lines, text)


class YamlSection:
    """One mapping of a file; remembers which keys were read so that `finish` can name the rest."""

    def __init__(
        self,
        path: Path,
        key_path: str,
        content: object,
        lines: Mapping[str, int] | None = None,
        text: str = "",
    ) -> None:
        """lines: of the file's key paths.  text: of the file."""
        self._path, self._lines, self.text_of_file = path, lines or {}, text
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

    def missing(self, key: str, expected: str) -> InputError:
        """The error for a key of this section without a value."""
        return self.error(key, _MISSING, expected)

    def error(self, key: str, found: object, expected: str) -> InputError:
        """The error for a key of this section."""
        where = ".".join(part for part in (self._key_path, key) if part) or "top level"
        if found is _MISSING:
            return MissingKeysError(
                self._path, [printable(f"{where}: found nothing, expected {expected}")]
            )
        msg = f"{self._at(where)}: {where}: found {found_text(found)}, expected {expected}"
        return InputError(printable(msg))

    def _at(self, key_path: str) -> str:
        """The file, with the line of the key or of what it is below, where it is known."""
        while key_path and key_path not in self._lines:
            key_path = re.sub(r"(\.|^)[^.\[]*$|\[\d+\]$", "", key_path)
        line = self._lines.get(key_path)
        return f"{self._path}:{line}" if line else str(self._path)

    def refused(self, problem: Exception) -> InputError:
        """The error for values with a problem that names section and key itself."""
        return InputError(f"{self._path}: {problem}")

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

    def check_version(self, version: int, kind: str) -> None:
        """Raise InputError for a file of another kind, or of another version of this one."""
        if "version" not in self._content:
            keys = shortened(", ".join(map(str, self._content)) or "nothing")
            msg = f"{self._path}: found {keys}, expected {kind} with version: {version}"
            raise InputError(printable(msg))
        self.integer("version", version, version)

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
        return YamlSection(self._path, f"{self._key_path}.{key}".lstrip("."), value, self._lines)

    def sections(self, key: str) -> Iterator[YamlSection]:
        """The mappings of a list; none where the key is absent."""
        self._read.add(key)
        value = self._content.get(key, [])
        if not isinstance(value, list):
            raise self.error(key, value, "a list of mappings")
        for number, item in enumerate(value):
            where = f"{self._key_path}.{key}[{number}]".lstrip(".")
            yield YamlSection(self._path, where, item, self._lines)

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

    def positive(self, key: str, high: float = math.inf, unit: str = "") -> float:
        """A finite number, 0 < number <= high."""
        limit = "" if math.isinf(high) else f", at most {high:g} {unit}".rstrip()
        expected = f"a number above 0{limit}"
        value = self.raw(key, expected)
        if not _is_number(value) or not 0 < value <= high:
            raise self.error(key, value, expected)
        return float(value)

    def integer(self, key: str, low: int, high: int) -> int:
        """A whole number, low <= number <= high."""
        expected = str(low) if low == high else "a whole number" + _range_text(low, high)
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
    near = get_close_matches(word[:100].lower(), by_lower, n=1, cutoff=MIN_SPELLING_SIMILARITY)
    return by_lower[near[0]] if near else ""


def read_by(
    read: Callable[[YamlSection, str], Any], key: str = "", *, required: bool = False
) -> Metadata:
    """Of a field that `read` reads from a section and a key.

    Parameters
    ----------
    read
        Raises InputError for what the key may not hold.
    key
        In the file, where it is not the field's name.
    required
        That the file has the key, even though the field has a default.
    """
    return {"read": read, "key": key, "required": required}


def whole(low: int, high: int, **more: Any) -> Metadata:
    """A whole number, low <= number <= high; `more` as `read_by`, for all that follow."""
    return read_by(lambda section, key: section.integer(key, low, high), **more)


def number(low: float = -math.inf, high: float = math.inf, unit: str = "", **more: Any) -> Metadata:
    """A finite number, low <= number <= high."""
    if unit:
        return read_by(lambda section, key: section.quantity(key, unit, low, high), **more)
    return read_by(lambda section, key: section.number(key, low, high), **more)


def positive(high: float = math.inf, unit: str = "", **more: Any) -> Metadata:
    """A finite number, 0 < number <= high."""
    return read_by(lambda section, key: section.positive(key, high, unit), **more)


def quantities(count: int, limits: tuple[float, float], unit: str, **more: Any) -> Metadata:
    """So many numbers, each within the limits."""
    return read_by(lambda section, key: section.quantities(key, unit, (limits,) * count), **more)


def choice(*words: str, **more: Any) -> Metadata:
    """One of the words."""
    return read_by(lambda section, key: section.choice(key, words), **more)


def text(**more: Any) -> Metadata:
    """A text that is not empty."""
    return read_by(YamlSection.text, **more)


def texts(**more: Any) -> Metadata:
    """A list of such texts, which may be empty."""
    return read_by(YamlSection.texts, **more)


def part(kind: type[Any], **more: Any) -> Metadata:
    """A mapping that makes another dataclass of such fields."""
    return read_by(lambda section, key: read_fields(section.section(key), kind), **more)


def or_else(default: Any, metadata: Metadata) -> Metadata:
    """As metadata, with a value for a file without the key; a file that is written has the key."""
    read = metadata["read"]

    def read_or_default(section: YamlSection, key: str) -> Any:
        return read(section, key) if key in section else default

    return {**metadata, "read": read_or_default}


def read_fields(section: YamlSection, kind: type[Part], **given: Any) -> Part:
    """The dataclass of all keys of a section.

    given: values of the fields that are not read here.
    Raises InputError for a key that is wrong, or none of the fields', and MissingKeysError,
    with all that are absent, here and below.
    """
    values = field_values(section, kind, **given)
    section.finish()
    try:
        return kind(**values)
    except InputError as error:
        # It names the section and the key already.
        raise section.refused(error) from None


def field_values(section: YamlSection, kind: type[Any], **given: Any) -> dict[str, Any]:
    """Values by field, for a dataclass that is made of more than them; else as `read_fields`."""
    values, missing = dict(given), list[str]()
    for item in fields(kind):
        if item.name in given or "read" not in item.metadata:
            continue
        key = item.metadata["key"] or item.name
        default = item.default is not MISSING or item.default_factory is not MISSING
        if key in section or item.metadata["required"] or not default:
            try:
                values[item.name] = item.metadata["read"](section, key)
            except MissingKeysError as error:
                missing += error.keys
    if missing:
        raise MissingKeysError(section.path, missing)
    return values
