"""The HTML page: one file that needs no other, with the figures inside."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from cmp_tactile_bringup.report.evaluation import TableRow
from cmp_tactile_bringup.report.results import DemoResults
from cmp_tactile_bringup.report.story import felt, force_caveat

__all__ = ["Picture", "write_page"]

MEDIA_TYPES = {".png": "image/png", ".webp": "image/webp"}

CSS = """
:root { color-scheme: light; }
body { font: 17px/1.6 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; color: #1f2933;
  max-width: 68rem; margin: 0 auto; padding: 2rem 1.5rem 4rem; }
h1 { font-size: 2.1rem; line-height: 1.2; margin: 0 0 .5rem; }
h2 { margin: 3rem 0 .6rem; font-size: 1.35rem; }
p { max-width: 48rem; }
.lead { font-size: 1.15rem; }
.verdict { display: inline-block; padding: .35rem .9rem; border-radius: .4rem; font-weight: 600; }
.good { background: #d7f0e5; color: #00533c; }
.bad { background: #fbdccb; color: #7a2e00; }
figure { margin: 1.2rem 0 0; }
figure img { width: 100%; height: auto; border: 1px solid #d9dfe5; border-radius: .4rem; }
figcaption { color: #52606d; font-size: .95rem; max-width: 56rem; margin-top: .4rem; }
.note { border-left: 4px solid #e69f00; padding: .2rem 1rem; background: #fdf6e6; }
table { border-collapse: collapse; margin-top: 1rem; }
th, td { text-align: left; padding: .35rem 1.2rem .35rem 0; border-bottom: 1px solid #d9dfe5; }
td.number { font-variant-numeric: tabular-nums; }
"""


@dataclass(frozen=True)
class Picture:
    """A figure of the page: heading, file, caption, and whether it shows force."""

    heading: str
    path: Path
    caption: str
    shows_force: bool = False


def write_page(
    results: DemoResults, rows: Sequence[TableRow], pictures: Sequence[Picture], path: Path
) -> Path:
    """Write the page; every picture is embedded in it."""
    parts = [
        _head(results),
        _verdict(rows),
        _introduction(results),
        *(_figure(picture, force_caveat(results)) for picture in pictures),
        "<h2>Measured in this run</h2>",
        _numbers(rows),
        "<h2>Made with</h2>",
        _facts(results.run.machine),
        "</body></html>",
    ]
    path.write_text("\n".join(parts), encoding="utf-8")
    return path


def _head(results: DemoResults) -> str:
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>cmp_tactile: what the sensor felt</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><style>{CSS}</style></head>
<body><h1>What the sensor felt</h1>
<p class="lead">{escape(results.recording.title)}: {len(results.recording.truth.stamp_ns)} camera
frames, turned into shape, displacement and force by the nodes of cmp_tactile.</p>"""


def _verdict(rows: Sequence[TableRow]) -> str:
    missed = [row.name for row in rows if row.passed is False]
    if missed:
        return f'<p class="verdict bad">Limits missed: {escape(", ".join(missed))}</p>'
    return '<p class="verdict good">All limits kept: no frame lost, every corner right</p>'


def _introduction(results: DemoResults) -> str:
    pattern = results.sensor.pattern
    told = " ".join(felt(results))
    return f"""<p>{escape(told)}</p>
<h2>What this is</h2>
<p>A camera looks through two mirrors at the inside of a soft gel. On the gel's skin is printed a
checkerboard with {pattern.rows} x {pattern.cols} crossings, {pattern.pitch * 1e3:.2f} mm apart:
a <em>continuous</em> marker pattern, whose lines tie every crossing to its neighbours. So each
crossing has a number that it keeps however far it moves. Two views of the same crossing give its
position in 3-D; how far it moved from rest is the displacement; what force moves the gel so is the
force field, and its sum the wrench.</p>"""


def _figure(picture: Picture, caveat: str) -> str:
    kind = MEDIA_TYPES[picture.path.suffix]
    data = base64.b64encode(picture.path.read_bytes()).decode("ascii")
    note = f'<p class="note">{escape(caveat)}</p>' if picture.shows_force else ""
    return f"""<h2>{escape(picture.heading)}</h2>{note}
<figure><img src="data:{kind};base64,{data}" alt="{escape(picture.heading)}">
<figcaption>{escape(picture.caption)}</figcaption></figure>"""


def _numbers(rows: Sequence[TableRow]) -> str:
    marks = {None: "", True: "kept", False: "<strong>missed</strong>"}
    lines = [
        f'<tr><td>{escape(row.name)}</td><td class="number">{escape(row.value)}</td>'
        f"<td>{escape(row.limit)}</td><td>{marks[row.passed]}</td></tr>"
        for row in rows
    ]
    head = "<tr><th>Quantity</th><th>Measured</th><th>Limit</th><th></th></tr>"
    return f"<table>{head}{''.join(lines)}</table>"


def _facts(facts: Mapping[str, str]) -> str:
    lines = [f"<tr><td>{escape(k)}</td><td>{escape(v)}</td></tr>" for k, v in facts.items()]
    return f"<table>{''.join(lines)}</table>"
