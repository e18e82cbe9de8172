"""Count source lines, modules, folders and functions of the repository.

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
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

SHIPPED = ("cmp_tactile_", "setup/", "underlay/")
SMALL = 40
LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


@dataclass(frozen=True)
class Module:
    """Source lines of a file, those that import or export, and those of each function."""

    path: Path
    lines: int
    imports: int
    functions: tuple[int, ...]

    @classmethod
    def from_file(cls, root: Path, path: str) -> Module:
        """Count a file of a checkout; SyntaxError for one that is not Python."""
        with tokenize.open(root / path) as file:
            tokens = list(tokenize.generate_tokens(file.readline))
        tree = ast.parse((root / path).read_text(encoding="utf-8"))
        source = {
            line
            for token in tokens
            if token.type not in LAYOUT
            for line in range(token.start[0], token.end[0] + 1)
        }
        source -= _lines_of(_docstrings(tree))
        functions = (
            node
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        )
        counts = tuple(len(source & _lines_of([function])) for function in functions)
        return cls(Path(path), len(source), len(source & _lines_of(_imports(tree))), counts)

    @property
    def is_test(self) -> bool:
        """Whether it is one, or serves tests alone."""
        return "/test" in f"/{self.path.as_posix()}" or self.path.name == "conftest.py"


def _lines_of(nodes: Iterable[ast.AST]) -> set[int]:
    return {line for node in nodes for line in range(node.lineno, node.end_lineno + 1)}  # type: ignore[attr-defined]


def _docstrings(tree: ast.AST) -> Iterator[ast.AST]:
    """Texts that stand alone as a statement."""
    for node in ast.walk(tree):
        alone = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if alone and isinstance(node.value.value, str):
            yield node


def _imports(tree: ast.AST) -> Iterator[ast.AST]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            yield node


def measure(root: Path) -> dict[str, float | str]:
    """All figures of a checkout, from the files that git knows."""
    listed = subprocess.run(
        ["git", "ls-files", "*.py"],  # noqa: S607
        cwd=root,
        capture_output=True,
        text=True,
        check=True,
    )
    modules = [Module.from_file(root, path) for path in listed.stdout.split()]
    tests = [module for module in modules if module.is_test]
    others = [module for module in modules if not module.is_test]
    shipped = [
        module
        for module in others
        if module.path.as_posix().startswith(SHIPPED) and module.path.name != "setup.py"
    ]
    small = [item for item in shipped if item.lines <= SMALL and item.path.name != "__init__.py"]
    lines = sum(module.lines for module in shipped)
    functions = sorted(count for module in shipped for count in module.functions)
    folder, most = Counter(str(module.path.parent) for module in shipped).most_common(1)[0]
    return {
        "shipped source lines": lines,
        "shipped modules": len(shipped),
        f"modules of {SMALL} source lines or fewer": len(small),
        "source lines of benchmarks": sum(
            item.lines for item in others if item.path.parts[0] == "benchmarks"
        ),
        "source lines of tests": sum(module.lines for module in tests),
        "imports and __all__, %": round(100 * sum(item.imports for item in shipped) / lines, 1),
        "modules of the largest folder": most,
        "largest folder": folder,
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
