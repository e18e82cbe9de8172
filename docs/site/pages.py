"""Gathers the pages of the site: the documents, and references that are made from the code.

`make docs` calls it and then MkDocs.  The documents keep their places, so their links hold; what a
page links to is copied beside it, and a link to a folder becomes plain text.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import yaml

from cmp_tactile_bringup.commands import CALIBRATIONS, IMPORTS, SUBCOMMANDS

ROOT = Path(__file__).resolve().parents[2]
# The documents, by where they are in the repository.
DOCUMENTS = (
    "*.md",
    "docs/*.md",
    "docs/tutorials/*.md",
    "*/README.md",
    "benchmarks/**/*.md",
    "test/data/*/README.md",
)
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)#\s]+)(#[^)]*)?\)")
PUBLIC = Path(__file__).with_name("public.yaml")
SEARCH = "disk_search.js"
HELP_COLUMNS = "84"


def documents() -> Iterator[Path]:
    """The documents, relative to the repository."""
    for pattern in DOCUMENTS:
        for path in sorted(ROOT.glob(pattern)):
            relative = path.relative_to(ROOT)
            if relative.parts[0] not in {"build", "install", "log", "demo_output"}:
                yield relative


def copy_document(relative: Path, target: Path) -> None:
    """The document with what it links to."""
    folder = (ROOT / relative).parent

    def adapted(link: re.Match[str]) -> str:
        text, address = link[2], link[3]
        linked = Path(os.path.normpath(folder / address))
        if "://" in address or not linked.exists():
            return link[0]
        if linked.is_dir():
            return text
        if linked.suffix != ".md":
            copied = target / linked.relative_to(ROOT)
            copied.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(linked, copied)
        return link[0]

    page = target / relative
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(LINK.sub(adapted, (ROOT / relative).read_text(encoding="utf-8")))


def commands() -> str:
    """What each command prints for --help."""
    named = [[], *([name] for name in SUBCOMMANDS)]
    named += [["calibrate", name] for name in CALIBRATIONS] + [["import", name] for name in IMPORTS]
    with ThreadPoolExecutor() as pool:
        texts = pool.map(_help, named)
    parts = (
        f"## {' '.join(['cmp_tactile', *words])}\n\n```text\n{text}\n```\n"
        for words, text in zip(named, texts, strict=True)
    )
    return "# Commands\n\nEach as `--help` shows it.\n\n" + "\n".join(parts)


def _help(words: list[str]) -> str:
    environment = {**os.environ, "COLUMNS": HELP_COLUMNS, "NO_COLOR": "1", "TERM": "dumb"}
    done = subprocess.run(
        [shutil.which("cmp_tactile") or "cmp_tactile", *words, "--help"],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    lines = (line.rstrip() for line in done.stdout.strip().splitlines())
    return "\n".join(lines)


def messages() -> str:
    """The message files."""
    folder = ROOT / "cmp_tactile_msgs" / "msg"
    parts = (
        f"## {path.stem}\n\n```text\n{path.read_text(encoding='utf-8').strip()}\n```\n"
        for path in sorted(folder.glob("*.msg"))
    )
    intro = "The messages of `cmp_tactile_msgs`; [nodes](docs/nodes.md) lists the topics."
    return f"# Messages\n\n{intro}\n\n" + "\n".join(parts)


def references() -> Iterator[tuple[str, str]]:
    """File and text of the pages of the API: what is public, by topic."""
    for page in yaml.safe_load(PUBLIC.read_text(encoding="utf-8")):
        names = "\n\n".join(f"::: {name}" for name in page["names"])
        yield f"api/{page['file']}.md", f"# {page['title']}\n\n{page['text']}\n\n{names}\n"


def main(target: Path) -> None:
    """Write all pages into that folder, which is emptied first."""
    shutil.rmtree(target, ignore_errors=True)
    for relative in documents():
        copy_document(relative, target)
    shutil.copyfile(Path(__file__).with_name(SEARCH), target / SEARCH)
    pages = {"commands.md": commands(), "messages.md": messages(), **dict(references())}
    for name, text in pages.items():
        page = target / name
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
