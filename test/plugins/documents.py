"""What a document shows of a command's output, compared with what the command prints."""

import re
from pathlib import Path

import pytest

NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?![\w.]*\w*/)")
ELLIPSIS = "..."


def shown_after(document: Path, command: str) -> list[str]:
    """The lines of the first block without a language that follows `command` in the document."""
    text = document.read_text(encoding="utf-8")
    assert text.count(command) >= 1, f"{document.name}: no {command!r}"
    after = text[text.index(command) + len(command) :]
    # The end of the command's own block is not the beginning of another.
    after = re.sub(r"\A.*\n```\n", "", after)
    found = re.search(r"^```\n(.*?)^```", after, re.MULTILINE | re.DOTALL)
    assert found, f"{document.name}: no output after {command!r}"
    return [line for line in found[1].splitlines() if line.strip() and line.strip() != ELLIPSIS]


def blocks(text: str, kind: str) -> list[str]:
    """Contents of the text's code blocks of a language."""
    return re.findall(rf"^```{kind}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def shell_lines(text: str) -> list[str]:
    """The lines of the text's shell blocks."""
    return [line for block in blocks(text, "sh") for line in block.splitlines() if line]


def assert_printed(
    shown: list[str], printed: str, *, rel: float = 0.0, absolute: float = 0.0, whole: bool = True
) -> None:
    """Each line that is shown was printed, in this order; other lines may lie between them.

    Words are equal but for their spaces.  Numbers with a decimal point differ by `rel` of the
    printed one, or by `absolute`; whole numbers not at all, where `whole`.  A line that ends with
    ... is compared up to there.
    """
    left = iter(printed.splitlines())
    for line in shown:
        assert any(_is_same(line, other, rel, absolute, whole) for other in left), (
            f"not printed here, within {rel:g} of it or {absolute:g}:\n{line}\nof\n{printed}"
        )


def _is_same(shown: str, printed: str, rel: float, absolute: float, whole: bool) -> bool:
    if shown.endswith(ELLIPSIS):
        shown = shown.removesuffix(ELLIPSIS)
        words = len(shown.split())
        printed = " ".join(printed.split()[:words])
    if _words(shown) != _words(printed):
        return False
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    return all(
        one == other
        if whole and "." not in one
        else float(one) == pytest.approx(float(other), rel=rel, abs=absolute)
        for one, other in pairs
    )


def _words(line: str) -> list[str]:
    # "(-0.00" and "( 0.00" have the same words.
    return re.sub(r"([(\[])\s+", r"\1", NUMBER.sub("#", line)).split()
