"""The page of the experiments in Markdown: texts, tables, figures, claims, differences."""

from __future__ import annotations

import math
import re
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import yaml

from cmp_tactile_bringup.terminal import machine_facts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


MET_WORDS = {True: "met", False: "not met", None: "-"}
CLAIM_HEAD = ("Section", "Claim", "The paper", "Here", "")
DEPARTURES = ("what", "paper", "here", "why")
DOTS_PER_INCH = 110


@dataclass(frozen=True)
class Claim:
    """A figure or sentence of the paper, compared with ours.

    section: of the paper.  met: None where the paper states nothing that could be missed.
    """

    section: str
    what: str
    paper: str
    ours: str
    met: bool | None


class Page:
    """What is written, in reading order.  folder: of the page and its figures."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.parts: list[str] = []
        self.claims: list[Claim] = []

    def heading(self, text: str, level: int = 2) -> None:
        """A title."""
        self.text(f"{'#' * level} {text}")

    def text(self, text: str) -> None:
        """A paragraph."""
        self.parts.append(" ".join(text.split()))

    def prose(self, experiment: str, *names: str, **values: object) -> None:
        """Paragraphs of prose.yaml with their fields filled in."""
        for name in names:
            self.text(_prose()[experiment]["texts"][name].format(**values))

    def table(self, key: str, rows: Iterable[Sequence[str]], **values: Any) -> None:
        """A table "EXPERIMENT.NAME"; its heads and what is said below it are those of prose.yaml.

        A head that is one field stands for all of its values.
        """
        written = _written("tables", key)
        heads: list[str] = []
        for head in written["head"]:
            several = values.get(head.strip("{}"))
            heads += several if isinstance(several, list | tuple) else [head.format(**values)]
        self.rows(heads, rows)
        self.text(written["caption"].format(**values))

    def rows(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """A table alone."""
        lines = [head, ["---"] * len(head), *rows]
        cells = ([text.replace("|", r"\|") for text in line] for line in lines)
        self.parts.append("\n".join(f"| {' | '.join(line)} |" for line in cells))

    def figure(self, figure: Figure, key: str, **values: object) -> None:
        """A figure "EXPERIMENT.NAME", which is written as PNG and closed; its caption as above.

        The same figure gives the same bytes.
        """
        import matplotlib.pyplot as plt

        path = self.folder / f"{key.replace('.', '_')}.png"
        figure.savefig(path, dpi=DOTS_PER_INCH, metadata={"Software": None})
        plt.close(figure)
        caption = " ".join(_written("figures", key).format(**values).split())
        first = re.split(r"\. (?=[A-Z])", caption)[0]  # not at "Fig. 10"
        self.parts.append(f"![{first}]({path.name})")
        self.text(caption)

    def claim(self, key: str, met: object, **values: object) -> None:
        """A row "EXPERIMENT.NAME" of the last table, in the words of prose.yaml.

        met: None where the paper states nothing that could be missed.
        """
        section = _prose()[key.partition(".")[0]]["section"]
        words = {name: text.format(**values) for name, text in _written("claims", key).items()}
        verdict = None if met is None else bool(met)
        self.claims.append(Claim(**{"section": section, **words}, met=verdict))

    def departures(self, experiment: str, **values: object) -> None:
        """The table of an experiment's departures from the paper, of prose.yaml."""
        rows = [
            [row[key].format(**values) for key in DEPARTURES]
            for row in _prose()[experiment]["deviations"]
        ]
        self.rows(("Departure from the paper", "The paper", "Here", "Why"), rows)

    def write(self, name: str) -> Path:
        """Write the page into its folder."""
        path = self.folder / name
        path.write_text("\n\n".join(self.parts) + "\n", encoding="utf-8")
        return path


def figures(form: str, *values: float) -> list[str]:
    """Numbers as a table has them, "-" for one that is not known.  form: as str.format takes it."""
    return ["-" if math.isnan(value) else form.format(value) for value in values]


@cache
def _prose() -> dict[str, Any]:
    """All that is written on the page, by experiment."""
    path = Path(__file__).with_name("prose.yaml")
    texts: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return texts


def _written(kind: str, key: str) -> Any:
    experiment, _, name = key.partition(".")
    return _prose()[experiment][kind][name]


def add_summary(page: Page, claims: Sequence[Claim], *, fast: bool) -> None:
    """How many claims are met, and the table of those that are not."""
    page.heading("Summary")
    missed = [claim for claim in claims if claim.met is False]
    met = sum(claim.met is True for claim in claims)
    rest = len(claims) - met - len(missed)
    page.text(
        f"{len(claims)} claims: {met} met, {len(missed)} not met; {rest} could not be missed. All "
        "are in the table of claims below; some ask the same of several methods, so that their "
        "number is no score."
    )
    if fast:
        page.text(
            "This is the fast run: fewer and smaller cases than the full one. Its figures are "
            "rougher, and a claim may come out otherwise than in the full run."
        )
    rows = [(f"{claim.section}: {claim.what}", claim.paper, claim.ours) for claim in missed]
    page.rows(("Not met", "The paper", "Here"), rows)


def add_claims(page: Page, claims: Sequence[Claim]) -> None:
    """The table of claims."""
    page.heading("Claims")
    rows = [(c.section, c.what, c.paper, c.ours, MET_WORDS[c.met]) for c in claims]
    page.rows(CLAIM_HEAD, rows)
    page.text("-: the paper states nothing that could be missed.")


def add_facts(page: Page, facts: Mapping[str, str], root: Path) -> None:
    """What the page was made with.  root: of the checkout."""
    page.heading("Made with")
    commit = subprocess.run(
        ("git", "-C", str(root), "describe", "--always", "--dirty"),  # noqa: S607
        capture_output=True, text=True, check=False,
    ).stdout.strip()  # fmt: skip
    page.rows(("", ""), {"Sources": commit or "no checkout", **facts, **machine_facts()}.items())
    page.prose("page", "seeds")


# Okabe and Ito's colours, distinguished also by colour-blind readers and on a grey print, where
# markers and lines help.
LOOKS = {
    "cmp": ("#0072B2", "o", "-"),
    "cmp_paper": ("#56B4E9", "s", "--"),
    "dmp_nearest": ("#D55E00", "^", "-"),
    "dmp_assignment": ("#009E73", "P", "-."),
    "dmp_grid": ("#E69F00", "D", "--"),
    "dmp_flow": ("#CC79A7", "v", ":"),
}
TRUE_COLOUR, PAPER_COLOUR = "#000000", "#777777"
WIDTH_IN = 9.0
STYLE: Any = {
    "backend": "Agg",
    "figure.constrained_layout.use": True,
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.markersize": 5.0,
    "image.interpolation": "nearest",
}


def panels(rows: int, columns: int, height: float, **options: Any) -> tuple[Figure, Any]:
    """A new figure of the page's width, height in inches, and its axes; options of `subplots`."""
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    mpl.use("Agg")
    mpl.rcParams.update(mpl.rcParamsDefault)
    mpl.rcParams.update(STYLE)
    return plt.subplots(rows, columns, figsize=(WIDTH_IN, height), **options)


def look(method: str, *, hollow: bool = False) -> dict[str, Any]:
    """Colour, line and marker of a method, by its key."""
    colour, marker, line = LOOKS[method]
    face = "white" if hollow else colour
    return {"color": colour, "marker": marker, "linestyle": line, "markerfacecolor": face}


def legend(
    figure: Figure, axes: Axes, columns: int, place: Literal["lower", "upper"] = "lower"
) -> None:
    """Name the lines of one panel for all, below the panels or in the "upper" margin."""
    handles, labels = axes.get_legend_handles_labels()
    margin: Any = f"outside {place} center"
    figure.legend(handles, labels, loc=margin, ncols=columns)
