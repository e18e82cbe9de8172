"""The page as one HTML file that needs no other, with its pictures inside."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path

from paper.experiment import Figure, Table, Text
from paper.page import MET_WORDS, Heading, PageBlock, alternative

__all__ = ["write_html"]

CODE = re.compile(r"`([^`\n]+)`")
CLASSES = {MET_WORDS[True]: "met", MET_WORDS[False]: "missed"}

CSS = """
:root { color-scheme: light; }
body { font: 16px/1.6 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; color: #1f2933;
  max-width: 68rem; margin: 0 auto; padding: 2rem 1.5rem 4rem; }
h1 { font-size: 2.1rem; line-height: 1.2; margin: 0 0 .5rem; }
h2 { margin: 3rem 0 .6rem; font-size: 1.35rem; }
p { max-width: 52rem; }
nav ul { columns: 2; padding-left: 1.2rem; }
figure { margin: 1.2rem 0; }
figure img { max-width: 100%; height: auto; border: 1px solid #d9dfe5; border-radius: .4rem; }
figcaption, caption { color: #52606d; font-size: .93rem; text-align: left; max-width: 56rem; }
caption { caption-side: bottom; padding-top: .4rem; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-size: .95rem; }
th, td { text-align: left; vertical-align: top; padding: .35rem 1.2rem .35rem 0;
  border-bottom: 1px solid #d9dfe5; font-variant-numeric: tabular-nums; overflow-wrap: anywhere;
  min-width: 3.5rem; }
.met { color: #00533c; font-weight: 600; }
.missed { color: #9a3b00; font-weight: 600; }
code { background: #f0f3f6; padding: 0 .25rem; border-radius: .2rem; font-size: .92em; }
"""


def write_html(blocks: Sequence[PageBlock], path: Path) -> Path:
    """Write the page; every picture is embedded in it."""
    headings = [block for block in blocks if isinstance(block, Heading)]
    title = next((heading.text for heading in headings if heading.level == 1), "")
    parts = [_head(title)]
    for number, block in enumerate(blocks):
        parts.append(_block(block, number))
        if isinstance(block, Heading) and block.level == 1:
            parts.append(_contents(blocks))
    parts.append("</body></html>")
    path.write_text("\n".join(parts) + "\n", encoding="utf-8")
    return path


def _head(title: str) -> str:
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><style>{CSS}</style></head>
<body>"""


def _contents(blocks: Sequence[PageBlock]) -> str:
    items = [
        f'<li><a href="#{_place(number)}">{_inline(block.text)}</a></li>'
        for number, block in enumerate(blocks)
        if isinstance(block, Heading) and block.level == 2
    ]
    return f"<nav><ul>{''.join(items)}</ul></nav>"


def _block(block: PageBlock, number: int) -> str:
    if isinstance(block, Heading):
        name = f"h{block.level}"
        return f'<{name} id="{_place(number)}">{_inline(block.text)}</{name}>'
    if isinstance(block, Text):
        return f"<p>{_inline(block.text)}</p>"
    if isinstance(block, Figure):
        return _figure(block)
    return _table(block)


def _figure(figure: Figure) -> str:
    data = base64.b64encode(figure.path.read_bytes()).decode("ascii")
    seen = escape(alternative(figure.caption))
    return f"""<figure><img src="data:image/png;base64,{data}" alt="{seen}">
<figcaption>{_inline(figure.caption)}</figcaption></figure>"""


def _table(table: Table) -> str:
    head = "".join(f"<th>{_inline(cell)}</th>" for cell in table.head)
    rows = "\n".join(f"<tr>{''.join(_cell(cell) for cell in row)}</tr>" for row in table.rows)
    caption = f"<caption>{_inline(table.caption)}</caption>" if table.caption else ""
    top = f"<thead><tr>{head}</tr></thead>" if any(table.head) else ""
    return f'<div class="wide"><table>{caption}{top}<tbody>\n{rows}\n</tbody></table></div>'


def _cell(text: str) -> str:
    kind = CLASSES.get(text)
    attribute = f' class="{kind}"' if kind else ""
    return f"<td{attribute}>{_inline(text)}</td>"


def _inline(text: str) -> str:
    return CODE.sub(r"<code>\1</code>", escape(text))


def _place(number: int) -> str:
    return f"part-{number}"
