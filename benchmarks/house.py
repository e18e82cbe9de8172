"""Count lines, modules, classes, errors and constants of the repository, beside their goals.

usage: house.py [--json] [CHECKOUT]

Source lines are those without blank lines, comments and docstrings. Shipped lines are those that
are installed: the packages without their tests, the set-up and the underlay.
Constants are the numbers that modules assign to names.
"""

from __future__ import annotations

import argparse
import ast
import json
import subprocess
import tokenize
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

# What one person can hold in mind; nobody is stopped by them.
GOALS = {
    "shipped source lines": 39_000,
    "shipped modules": 260,
    "classes": 520,
    "error classes": 10,
    "constants": 800,
    "source lines of tests": 23_000,
    "source lines of benchmarks": 8_000,
}
SHIPPED = ("cmp_tactile_", "setup/", "underlay/")
LAYOUT = {
    getattr(tokenize, name)
    for name in ("COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENCODING", "ENDMARKER")
}


@dataclass(frozen=True)
class Module:
    """Of a file: source lines, those of each function, classes, errors among them, constants."""

    lines: int
    functions: list[int]
    classes: int
    errors: int
    constants: int

    @classmethod
    def from_file(cls, path: Path) -> Module:
        """Count."""
        with tokenize.open(path) as file:
            tokens = list(tokenize.generate_tokens(file.readline))
        tree = ast.parse(path.read_text(encoding="utf-8"))
        nodes = list(ast.walk(tree))
        source = {
            line
            for token in tokens
            if token.type not in LAYOUT
            for line in range(token.start[0], token.end[0] + 1)
        }
        for node in nodes:
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                source -= _lines_of(node)
        functions = [n for n in nodes if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
        classes = [node for node in nodes if isinstance(node, ast.ClassDef)]
        return cls(
            lines=len(source),
            functions=[len(source & _lines_of(function)) for function in functions],
            classes=len(classes),
            errors=sum(map(_is_error, classes)),
            constants=sum(map(_constants, tree.body)),
        )


def _is_error(node: ast.ClassDef) -> bool:
    return any(ast.unparse(base).endswith(("Error", "Exception")) for base in node.bases)


def _constants(node: ast.stmt) -> int:
    """How many names an assignment of numbers gives."""
    if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
        return 0
    values = (item.value for item in ast.walk(node.value) if isinstance(item, ast.Constant))
    if not any(type(value) in (int, float) for value in values):
        return 0
    target = node.targets[0] if isinstance(node, ast.Assign) else node.target
    return len(target.elts) if isinstance(target, ast.Tuple) else 1


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
    modules = [Module.from_file(root / path) for path in shipped]
    functions = sorted(lines for module in modules for lines in module.functions)

    def total(chosen: Iterable[str]) -> int:
        return sum(Module.from_file(root / path).lines for path in chosen)

    return {
        "shipped source lines": sum(module.lines for module in modules),
        "shipped modules": len(shipped),
        "classes": sum(module.classes for module in modules),
        "error classes": sum(module.errors for module in modules),
        "constants": sum(module.constants for module in modules),
        "source lines of tests": total(filter(_is_test, paths)),
        "source lines of benchmarks": total(p for p in others if p.startswith("benchmarks/")),
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
        goal = f"   (goal {GOALS[name]:,})" if name in GOALS else ""
        print(f"{name:<38} {value:>7,}{goal}")


if __name__ == "__main__":
    main()
