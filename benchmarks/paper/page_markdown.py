"""The page as Markdown, with its pictures as files beside it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

from paper.experiment import Figure, Table, Text
from paper.page import Heading, PageBlock, alternative

__all__ = ["write_markdown"]

CODE = re.compile(r"(`[^`\n]+`)")
SPECIAL = re.compile(r"([\\*_\[\]<>|`])")
# At the beginning of a line these would begin a list, a heading or a quotation.
LINE_BEGIN = re.compile(r"^(\s*)([-+#]|\d+(?=[.)]))")


def write_markdown(blocks: Iterable[PageBlock], path: Path) -> Path:
    """Write the page; links to figures are relative to its folder."""
    parts = [_block(block, path.parent) for block in blocks]
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return path


def _block(block: PageBlock, folder: Path) -> str:
    if isinstance(block, Heading):
        return f"{'#' * block.level} {_inline(block.text)}"
    if isinstance(block, Text):
        return _paragraph(block.text)
    if isinstance(block, Figure):
        place = Path(os.path.relpath(block.path, folder)).as_posix().replace(" ", "%20")
        caption = _paragraph(block.caption)
        return f"![{_inline(alternative(block.caption))}]({place})\n\n{caption}"
    return _table(block)


def _table(table: Table) -> str:
    lines = [_row(table.head), _row(("---",) * len(table.head), escaped=True)]
    lines += [_row(row) for row in table.rows]
    text = "\n".join(lines)
    return f"{text}\n\n{_paragraph(table.caption)}" if table.caption else text


def _row(cells: Iterable[str], *, escaped: bool = False) -> str:
    told = (cell if escaped else _inline(cell, in_table=True) for cell in cells)
    return f"| {' | '.join(told)} |"


def _paragraph(text: str) -> str:
    return LINE_BEGIN.sub(r"\1\\\2", _inline(text))


def _inline(text: str, *, in_table: bool = False) -> str:
    """Escaped, but for what stands between backquotes."""
    parts = CODE.split(" ".join(text.split()))
    # A table ends its cell at any bar, also at one in code.
    code = [part.replace("|", r"\|") if in_table else part for part in parts[1::2]]
    parts[1::2] = code
    parts[::2] = [SPECIAL.sub(r"\\\1", part) for part in parts[::2]]
    return "".join(parts)
