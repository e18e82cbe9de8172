"""Comments of a YAML file by the key that they are about: its parser forgets them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import yaml

# The line breaks of YAML, which are fewer than those of `str.splitlines`.
LINE_BREAK = re.compile("\r\n|[\n\r\x85\u2028\u2029]")
COMMENT_LINE = re.compile(r"\s*(#.*)")
BEHIND_A_VALUE = re.compile(r"\s+#\s*(.*\S)")
BEHIND_A_KEY = re.compile(r"\s*:\s+#\s*(.*\S)")


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
