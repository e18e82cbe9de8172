"""Count source lines, modules and functions of the repository.

usage: house.py [--json] [CHECKOUT]

Source lines are those without blank lines, comments and docstrings. Shipped lines are those that
are installed: the packages without their tests, the set-up and the underlay.
"""

from __future__ import annotations

import argparse
import ast
import json
import subprocess
import tokenize
from collections.abc import Iterable
from pathlib import Path

SHIPPED = ("cmp_tactile_", "setup/", "underlay/")
LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


def count(path: Path) -> tuple[int, list[int]]:
    """Source lines of a file, and those of each of its functions."""
    with tokenize.open(path) as file:
        tokens = list(tokenize.generate_tokens(file.readline))
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    source = {
        line
        for token in tokens
        if token.type not in LAYOUT
        for line in range(token.start[0], token.end[0] + 1)
    }
    for node in nodes:
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            source -= _lines_of(node)
    functions = (node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))
    return len(source), [len(source & _lines_of(function)) for function in functions]


def _lines_of(node: ast.stmt) -> set[int]:
    return set(range(node.lineno, (node.end_lineno or node.lineno) + 1))


def _is_test(path: str) -> bool:
    return "/test" in f"/{path}" or path.endswith("conftest.py")


def measure(root: Path) -> dict[str, int]:
    """All figures of a checkout, from the files that git knows."""
    command = ["git", "ls-files", "*.py"]
    listed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    paths = listed.stdout.split()
    others = [path for path in paths if not _is_test(path)]
    shipped = [
        path for path in others if path.startswith(SHIPPED) and not path.endswith("setup.py")
    ]
    functions = sorted(lines for path in shipped for lines in count(root / path)[1])
    benchmarks = [path for path in others if path.startswith("benchmarks/")]

    def total(chosen: Iterable[str]) -> int:
        return sum(count(root / path)[0] for path in chosen)

    return {
        "shipped source lines": total(shipped),
        "shipped modules": len(shipped),
        "source lines of benchmarks": total(benchmarks),
        "source lines of tests": total(filter(_is_test, paths)),
        "90 % of the functions are below": functions[int(0.9 * len(functions))],
        "longest function": functions[-1],
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print the figures as one line of JSON")
    parser.add_argument("checkout", nargs="?", type=Path, default=Path(__file__).parents[1])
    arguments = parser.parse_args()
    figures = measure(arguments.checkout)
    if arguments.json:
        print(json.dumps(figures))
        return
    for name, value in figures.items():
        print(f"{name:<38} {value}")


if __name__ == "__main__":
    main()
