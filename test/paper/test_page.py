"""The page: everything is on it, also what is missing, and no text becomes markup."""

import itertools
from html.parser import HTMLParser
from pathlib import Path

import pytest

from paper.blocks import Claim, Deviation, Figure, Report, Table, Text
from paper.experiment import Experiment
from paper.page import (
    Heading,
    RunFacts,
    all_claims,
    alternative,
    commit_of,
    page_blocks,
    write_page,
)
from paper.runner import Cost, ExperimentResult, Failure

PNG = b"\x89PNG not looked at"


def _experiment(key: str, section: str, title: str) -> Experiment:
    return Experiment(key, section, title, lambda _: [], lambda *_: Report(()))


@pytest.fixture
def results(tmp_path: Path) -> list[ExperimentResult]:
    picture = tmp_path / "figures" / "a b.png"
    picture.parent.mkdir()
    picture.write_bytes(PNG)
    report = Report(
        (
            Text("1. SNR < 0.95 & `a_b|c`, *not* [a](b) <script>"),
            Table(("method", "x|y"), (("CMP", "`a|b` < 1"),), "A <caption>"),
            Figure(picture, "Errors of `dmp`. More."),
        ),
        (
            Claim("IV.D", "DMP | worse", "yes", "no", met=False),
            Claim("IV.C", "error", "< 0.02 mm", "0.001 mm", met=True),
            Claim("V.A", "speed", "24 Hz", "30 Hz", met=None),
        ),
        (Deviation("load", "50 N", "5 N", "a <soft> gel"),),
    )
    good = ExperimentResult(_experiment("good", "IV.C", "Objects <five>"), report)
    good.costs.append(Cost("sphere", "'sphere', 7", 61.0, 60.0, kept=True, steady=False))
    bad = ExperimentResult(_experiment("bad", "", "Patterns"))
    bad.failures.append(Failure("case sweep", "ValueError: <none>", "trace"))
    return [good, bad]


class _Reader(HTMLParser):
    """Texts of a page, and the tags that are open at each."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.texts: list[tuple[str, str]] = []
        self.tags: list[str] = []
        self.sources: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if data.strip():
            self.texts.append((self.open[-1], data))


def _read(path: Path) -> _Reader:
    reader = _Reader()
    reader.feed(path.read_text(encoding="utf-8"))
    reader.close()
    assert reader.open == []
    return reader


def _facts(tmp_path: Path) -> RunFacts:
    return RunFacts(fast=True, wall=100.0, processes=2, root=tmp_path, left_out=("Balls",))


def test_the_html_page_is_whole_by_itself_and_escapes_texts(
    results: list[ExperimentResult], tmp_path: Path
) -> None:
    page = _read(write_page(page_blocks(results, _facts(tmp_path)), tmp_path))
    assert "script" not in page.tags
    words = "".join(text for _, text in page.texts)
    for text in (
        "1. SNR < 0.95 & a_b|c, *not* [a](b) <script>",
        "A <caption>",
        "a <soft> gel",
        "Objects <five>",
        "ValueError: <none>",
        "Not asked for, and so not on this page: Balls.",
        "This is the fast run",
        "3 claims: 1 met, 1 not met; 1 of them could not be missed.",
        "sphere",
        "no Git checkout",
        "with 2 processes of one thread each",
    ):
        assert text in words
    assert ("code", "a_b|c") in page.texts
    assert page.tags.count("img") == 1
    assert all(source.startswith(("data:image/png;base64,", "#")) for source in page.sources)


def test_markdown_escapes_texts_and_links_pictures(
    results: list[ExperimentResult], tmp_path: Path
) -> None:
    write_page(page_blocks(results, _facts(tmp_path)), tmp_path)
    lines = (tmp_path / "paper.md").read_text(encoding="utf-8").splitlines()
    assert r"\1. SNR \< 0.95 & `a_b|c`, \*not\* \[a\](b) \<script\>" in lines
    assert r"| method | x\|y |" in lines
    assert r"| CMP | `a\|b` \< 1 |" in lines
    assert "![Errors of dmp](figures/a%20b.png)" in lines
    for line, following in itertools.pairwise(lines):
        if following.startswith("| --- "):
            bars = line.replace(r"\|", "").count("|")
            assert bars == following.count("|")


@pytest.mark.parametrize(
    ("caption", "seen"),
    [
        ("As the paper's Fig. 11: of `CMP`, um. Black: it.", "As the paper's Fig. 11: of CMP, um"),
        ("Spheres of 0.5 mm, as Fig. 12 (b).", "Spheres of 0.5 mm, as Fig. 12 (b)"),
        ("One; two.", "One"),
    ],
)
def test_a_picture_is_described_by_the_first_sentence(caption: str, seen: str) -> None:
    assert alternative(caption) == seen


def test_claims_stand_in_the_order_of_the_page_with_their_verdicts(
    results: list[ExperimentResult], tmp_path: Path
) -> None:
    assert [claim.what for claim in all_claims(results)] == ["DMP | worse", "error", "speed"]
    blocks = page_blocks(results, _facts(tmp_path))
    at = blocks.index(Heading("Claims"))
    table = blocks[at + 1]
    assert isinstance(table, Table)
    assert [row[-1] for row in table.rows] == ["not met", "met", "–"]
    headings = [block.text for block in blocks if isinstance(block, Heading)]
    assert headings.index("What a simulation cannot show") < headings.index("IV.C: Objects <five>")
    assert headings[-3:] == ["Beyond the paper: Patterns", "Claims", "Made with"]
    deviations = [b for b in blocks if isinstance(b, Table) and b.head[0].startswith("Departure")]
    assert [table.rows for table in deviations] == [(("load", "50 N", "5 N", "a <soft> gel"),)]


def test_the_commit_says_whether_the_tree_was_changed(tmp_path: Path) -> None:
    import subprocess

    def git(*command: str) -> None:
        who = ("-c", "user.name=a", "-c", "user.email=a@example.org")
        subprocess.run(["git", "-C", str(tmp_path), *who, *command], check=True)

    git("init", "-q")
    (tmp_path / "a").touch()
    git("add", "a")
    git("commit", "-q", "-m", "a")
    assert commit_of(tmp_path).endswith("nothing changed")
    (tmp_path / "b").touch()
    assert commit_of(tmp_path).endswith("1 file changed or added since")
