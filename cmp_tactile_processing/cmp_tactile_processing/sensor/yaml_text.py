"""YAML as text: bounded reading of what people give, writing of files that people read.

A written file keeps the comments of an older one, by the key that they are about: the parser
forgets them.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from yaml.composer import Composer
from yaml.parser import Parser
from yaml.reader import Reader, ReaderError
from yaml.resolver import Resolver
from yaml.scanner import Scanner

from cmp_tactile_processing.errors import InputError, found_text, printable, shortened

# Far more than a scene has; an alias counts as all that it stands for.
MAX_NODES = 30_000
MAX_DEPTH = 40
# Far more than a float has; Python itself refuses to convert more than 4300.
MAX_DIGITS = 1000
LAYOUT: Mapping[str, Any] = {"sort_keys": False, "width": 100, "allow_unicode": True}
PLAIN_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*")
# Words that YAML 1.1 may read as booleans and PyYAML does not.
BOOLEAN_LETTERS = ("y", "n")

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

# The line breaks of YAML, which are fewer than those of `str.splitlines`.
LINE_BREAK = re.compile("\r\n|[\n\r\x85\u2028\u2029]")
COMMENT_LINE = re.compile(r"\s*(#.*)")
BEHIND_A_VALUE = re.compile(r"\s+#\s*(.*\S)")
BEHIND_A_KEY = re.compile(r"\s*:\s+#\s*(.*\S)")


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
        """The document; InputError for what is refused, YAMLError for what is not YAML."""
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
                raise self._refused(
                    f"an alias of a value that contains it, *{event.anchor}", "none"
                )
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
            raise self._refused("more nested levels", f"at most {MAX_DEPTH} nested levels")

    def _refused(self, found: str, expected: str) -> InputError:
        where = self.key_path or "top level"
        msg = f"{self._path}: {where}: found {found}, expected {expected}"
        return InputError(printable(msg))


class _Dumper(yaml.SafeDumper):
    """Puts quotes around what the loader would not read as a text."""

    yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002  the base class has it
        """Always: no anchors in files that people read."""
        return True


def yaml_value(text: str) -> Any:
    """A value as it would stand in a file; InputError where it cannot."""
    return yaml_content(Path("value"), text)


def yaml_content(path: Path, text: str) -> Any:
    """The document in a text of the file, of plain mappings, lists, texts, numbers and None.

    Raises InputError, naming file and key path, for what is not YAML or beyond the bounds.
    """
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
    raise InputError(msg)


def yaml_comments(path: Path, text: str) -> dict[str, Comment]:
    """The comments of a text that `yaml_content` reads, by key path."""
    root = _Loader(path, text).get_single_node() if "#" in text else None
    return {} if root is None else comments_of(text, root)


def _below(key_path: str, key: str | int) -> str:
    if isinstance(key, int):
        return f"{key_path}[{key}]"
    return f"{key_path}.{shortened(str(key))}".lstrip(".")


def dump_yaml(mapping: Mapping[str, Any]) -> str:
    """A mapping as a file that `read_yaml` reads back."""
    text: str = yaml.dump(dict(mapping), Dumper=_Dumper, **LAYOUT)
    return text


def yaml_number(value: float) -> str:
    """The shortest decimal that reads back as the same float, with the point YAML 1.1 asks for."""
    number = float(value)
    if math.isnan(number):
        return ".nan"
    if math.isinf(number):
        return ".inf" if number > 0 else "-.inf"
    mantissa, exponent, power = repr(number).partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}{exponent}{power}"


def yaml_numbers(values: Iterable[float]) -> str:
    """A list of floats in one line."""
    return f"[{', '.join(yaml_number(value) for value in values)}]"


def yaml_text(text: str) -> str:
    """A text as YAML reads it back: plain where it is a word that means nothing else."""
    plain = PLAIN_WORD.fullmatch(text) and text.lower() not in BOOLEAN_LETTERS
    if plain and yaml.safe_load(text) == text:
        return text
    quoted: str = yaml.safe_dump(text, default_style='"', width=math.inf, allow_unicode=True)
    return quoted.rstrip("\n")


@dataclass(frozen=True)
class Comment:
    """What a file says of one key.

    above: the lines above it, with their #.  behind: the text after the value, without it.
    about: the key's lines as they are written without comments; the comment is kept as long as
    these stay the same.
    """

    above: tuple[str, ...] = ()
    behind: str = ""
    about: tuple[str, ...] = ()


def comments_of(text: str, root: yaml.Node) -> dict[str, Comment]:
    """Comments by key path ("views.left.roi", "optics.layers[0]"); "" for those of the whole file.

    text: the file.  root: its mapping.  What lies above the first key is about the whole file.  In
    mappings and lists on one line no comment is looked for.
    """
    return dict(_Finder(text).comments(root))


class _Finder:
    """Walks through a document from above; each line of comment is given out once."""

    def __init__(self, text: str) -> None:
        self._lines = LINE_BREAK.split(text)
        self._taken = -1

    def comments(self, root: yaml.Node) -> Iterator[tuple[str, Comment]]:
        if isinstance(root, yaml.MappingNode) and root.value and not root.flow_style:
            above = self._above(root.value[0][0].start_mark)
            if above:
                yield "", Comment(above)
            yield from self._below(root, "")

    def _below(self, node: yaml.Node, path: str) -> Iterator[tuple[str, Comment]]:
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                name = f"{path}.{key.value}".lstrip(".")
                yield from self._entry(name, key.start_mark, key.end_mark, value)
        elif isinstance(node, yaml.SequenceNode):
            for number, item in enumerate(node.value):
                yield from self._entry(f"{path}[{number}]", item.start_mark, None, item)

    def _entry(
        self, path: str, start: yaml.Mark, end: yaml.Mark | None, value: yaml.Node
    ) -> Iterator[tuple[str, Comment]]:
        """end: of the key, where there is one."""
        above = self._above(start)
        is_block = isinstance(value, yaml.CollectionNode) and not value.flow_style
        behind = ""
        if not is_block:
            behind = self._behind(value.end_mark, BEHIND_A_VALUE)
        elif end is not None:
            behind = self._behind(end, BEHIND_A_KEY)
        if above or behind:
            yield path, Comment(above, behind)
        if is_block:
            yield from self._below(value, path)

    def _above(self, mark: yaml.Mark) -> tuple[str, ...]:
        """Lines of comment between what lies above, and the mark's line."""
        found: list[str] = []
        number = mark.line - 1
        while number > self._taken:
            line = self._lines[number]
            comment = COMMENT_LINE.fullmatch(line)
            if comment:
                found.insert(0, comment[1].rstrip())
            elif line.strip():
                break
            number -= 1
        self._taken = max(self._taken, mark.line - 1)
        return tuple(found)

    def _behind(self, mark: yaml.Mark, pattern: re.Pattern[str]) -> str:
        """The comment on the rest of the line, with the lines that go on in its column."""
        line = self._lines[mark.line]
        found = pattern.fullmatch(line.rstrip(), mark.column)
        if not found:
            return ""
        texts, column = [found[1]], line.index("#", mark.column)
        number = mark.line
        while number + 1 < len(self._lines):
            comment = COMMENT_LINE.fullmatch(self._lines[number + 1])
            if not comment or comment.start(1) != column:
                break
            number += 1
            texts.append(comment[1].strip("# \t"))
        self._taken = max(self._taken, number)
        return " ".join(texts)


def with_values(
    comments: Mapping[str, Comment], lines: Sequence[tuple[str, str]]
) -> dict[str, Comment]:
    """The comments with what they are about.

    lines: key path and text of every line of the file as it is written without comments.  A
    comment on a part of a line becomes one on the line that names the part; one on what is not
    written is left out.
    """
    found: dict[str, Comment] = {}
    for path, comment in comments.items():
        place = _written_place(path, lines)
        if place is None:
            continue
        part = path.removeprefix(place).lstrip(".")
        behind = f"{part}: {comment.behind}" if part and comment.behind else comment.behind
        before = found.get(place, Comment())
        found[place] = Comment(
            above=(*before.above, *comment.above),
            behind="; ".join(text for text in (before.behind, behind) if text),
            about=lines_of(lines, place),
        )
    return found


def _written_place(path: str, lines: Sequence[tuple[str, str]]) -> str | None:
    """The path itself, or that of the only line that the key is on."""
    known, place = {name for name, _ in lines}, path
    while place and place not in known:
        place = place.rpartition(".")[0]
    return place if place == path or len(lines_of(lines, place)) == 1 else None


def lines_of(lines: Sequence[tuple[str, str]], path: str) -> tuple[str, ...]:
    """The lines of a key and of all below it; all lines for the empty path."""
    below = (f"{path}.", f"{path}[")
    return tuple(text for name, text in lines if not path or name == path or name.startswith(below))
