#!/usr/bin/env python3
"""How the results depend on each number at a module's top: at half, at twice, at zero, and huge.

    setup/run python3 benchmarks/constants.py tracking --output benchmarks/results/constants.md

An import hook makes every function of the chosen packages read its constants from memory at a fixed
address, compiled kernels as well. Each value is tried in a forked process, so nothing is compiled
twice. A constant is measured on those frames of which a function that reads it is run. The first
run compiles for some minutes. Frames, compiled code and results are kept in benchmark_output, and a
later run goes on there; delete them after a change.
"""

from __future__ import annotations

import ast
import ctypes
import functools
import gc
import hashlib
import importlib
import itertools
import json
import math
import mmap
import os
import pickle
import re
import resource
import select
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib.abc import MetaPathFinder
from importlib.machinery import PathFinder, SourceFileLoader
from operator import itemgetter
from pathlib import Path
from time import perf_counter
from types import ModuleType
from typing import Any

import numpy as np
from tables import CommandLine, head, line

ROOT = "cmp_tactile_processing"
# Where slots lie: 8 bytes of value and 8 that say whether it was read, for each constant.
ADDRESS, SLOTS = 0x6E0000000000, 4096
MAP_FIXED_NOREPLACE = 0x100000
# More memory, bytes, or time, times that of the usual value and s, ends a trial.
MEMORY_LIMIT, TIME_RATIO, LEAST_TIME_S = 3 << 30, 4.0, 20.0
# Half and twice are tried on about so many units.  What changes nothing there is then set to zero
# and to a huge value on more of them.
FEW_UNITS, MANY_UNITS = 24, 60
# Changes of errors below this share are not printed.
LEAST_RATIO = 5e-4
CHANGES = {"half": 0.5, "twice": 2.0, "zero": 0.0, "huge": 1e3}
HEADER = """# Constants at half, twice, zero, and a thousand times their value

Made by `constants.py`. Counts are changes over all views of the units: corners found, corners with
wrong numbers, views refused. Errors are changes of the RMS. `-`: every result is equal to the last
bit. An empty cell was not tried, because half or twice show an effect already. `units` read the
constant: half and twice are tried on 24 of them at most, zero and a thousand times on 60. `force`
and `slip` have 5 units: a rendered slide of a ball, and displacements with noise of two balls,
shears and a flat pin, on gels of both models. That is few: ask the tests before a number goes."""
CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*")
# A constant in these is a size of an array or a place in one.
SIZED = {"empty", "zeros", "ones", "full", "reshape"}
CACHE = type(functools.cache(len))
Name = tuple[str, str]
Figures = dict[str, Any]
Unit = Callable[[], tuple[Figures, str]]


def fixed_memory() -> np.ndarray[Any, np.dtype[np.float64]]:
    """Values and marks (SLOTS, 2) float64 at ADDRESS, so that compiled code can be kept."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.restype = ctypes.c_void_p
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | MAP_FIXED_NOREPLACE
    protection = mmap.PROT_READ | mmap.PROT_WRITE
    size = ctypes.c_size_t(16 * SLOTS)
    found = libc.mmap(ctypes.c_void_p(ADDRESS), size, protection, flags, -1, ctypes.c_long(0))
    if found != ADDRESS:
        sys.exit(f"0x{ADDRESS:x}: found memory in use, expected none")
    return np.ctypeslib.as_array((ctypes.c_double * (2 * SLOTS)).from_address(ADDRESS)).reshape(
        SLOTS, 2
    )


MEMORY = fixed_memory()


def read_float(slot: int) -> float:
    """The value of a constant."""
    MEMORY[slot, 1] = 1.0
    return float(MEMORY[slot, 0])


def read_int(slot: int) -> int:
    """The value of a constant that is a whole number."""
    MEMORY[slot, 1] = 1.0
    return int(MEMORY[slot, 0])


def compile_reading() -> None:
    """Make numba load from memory where a kernel calls one of the two functions above."""
    from llvmlite import ir
    from numba import types
    from numba.extending import intrinsic, overload

    @intrinsic  # type: ignore[misc]
    def load(context: Any, slot: Any) -> Any:  # noqa: ARG001
        def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
            def pointer(offset: int) -> Any:
                place = builder.mul(values[0], ir.Constant(values[0].type, 16))
                place = builder.add(place, ir.Constant(values[0].type, ADDRESS + offset))
                return builder.inttoptr(place, ir.DoubleType().as_pointer())

            builder.store(ir.Constant(ir.DoubleType(), 1.0), pointer(8))
            return builder.load(pointer(0))

        return types.float64(types.int64), code

    overload(read_float)(lambda slot: lambda slot: load(slot))  # noqa: ARG005, PLW0108
    overload(read_int)(lambda slot: lambda slot: int(load(slot)))  # noqa: ARG005


class Constants(MetaPathFinder):
    """The numbers at the tops of a package's modules; a finder that loads these modules.

    slots: number of each constant.  kinds: int or float, of those that are scalars.  reasons: why
    a constant cannot be varied.
    """

    def __init__(self) -> None:
        folder = Path(next(iter(PathFinder.find_spec(ROOT).submodule_search_locations))).resolve()
        self.sources = {self._module(folder, path): path for path in sorted(folder.rglob("*.py"))}
        self.trees = {name: ast.parse(path.read_text()) for name, path in self.sources.items()}
        names = [(m, name) for m, tree in self.trees.items() for name in _assigned(tree)]
        self.slots = {name: slot for slot, name in enumerate(names)}
        self.kinds: dict[Name, type] = {}
        self.reasons: dict[Name, str] = {}
        self.used: set[Name] = set()
        self.known = {module: self._known(module, tree) for module, tree in self.trees.items()}
        for module, tree in self.trees.items():
            for name in self._sizes(module, tree):
                self.reasons[name] = "size or index"

    @staticmethod
    def _module(folder: Path, path: Path) -> str:
        parts = path.relative_to(folder).with_suffix("").parts
        return ".".join([ROOT, *(part for part in parts if part != "__init__")])

    def _known(self, module: str, tree: ast.Module) -> dict[str, Name]:
        """Constants by the name that a module gives them, "alias.NAME" in another module."""
        found = {name: (owner, name) for owner, name in self.slots if owner == module}
        for node in ast.walk(tree):
            if not isinstance(node, ast.ImportFrom) or not node.module:
                continue
            for item in node.names:
                alias, whole = item.asname or item.name, f"{node.module}.{item.name}"
                if (node.module, item.name) in self.slots:
                    found[alias] = node.module, item.name
                found |= {f"{alias}.{name}": (m, name) for m, name in self.slots if m == whole}
        return found

    def _sizes(self, module: str, tree: ast.Module) -> Iterator[Name]:
        for node in ast.walk(tree):
            parts: list[ast.AST] = []
            if isinstance(node, ast.Subscript) and not isinstance(node.slice, ast.Slice):
                parts = [node.slice]
            elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") in SIZED:
                parts = [*node.args]
            for part in parts:
                for inner in ast.walk(part):
                    name = self.known[module].get(_dotted(inner))
                    if name is not None:
                        yield name

    def find_spec(self, name: str, path: Any, target: ModuleType | None = None) -> Any:
        """That of a module with this class's loader."""
        spec = PathFinder.find_spec(name, path, target) if name in self.sources else None
        if spec is not None and spec.origin:
            spec.loader = _Loader(name, spec.origin, self)
        return spec


class _Loader(SourceFileLoader):
    """Executes a module twice: to know the values, then with functions that read them."""

    def __init__(self, name: str, path: str, constants: Constants) -> None:
        super().__init__(name, path)
        self._constants = constants

    def exec_module(self, module: ModuleType) -> None:
        """Load it."""
        known, source = self._constants, Path(self.path).read_text(encoding="utf-8")
        first = vars(module)
        exec(compile(source, self.path, "exec", dont_inherit=True), first)  # noqa: S102
        for name in (name for name in known.slots if name[0] == self.name):
            value = first.get(name[1])
            if type(value) in (int, float):
                known.kinds[name] = type(value)
                MEMORY[known.slots[name], 0] = value
        tree = ast.fix_missing_locations(_Reading(known, self.name).visit(ast.parse(source)))
        vars(module).update(_read_float=read_float, _read_int=read_int)
        exec(compile(tree, self.path, "exec", dont_inherit=True), vars(module))  # noqa: S102


class _Reading(ast.NodeTransformer):
    """Makes a function read its constants when it is called."""

    def __init__(self, constants: Constants, module: str) -> None:
        self._all, self._known = constants, constants.known[module]
        self._read: dict[str, Name] | None = None
        self._own: set[str] = set()

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        outer, self._read, own = self._read, {}, self._own
        self._own = {item.arg for item in ast.walk(node) if isinstance(item, ast.arg)}
        node.body = [self.visit(statement) for statement in node.body]
        read = [
            ast.parse(f"{alias} = _read_{self._all.kinds[name].__name__}({self._all.slots[name]})")
            for alias, name in self._read.items()
        ]
        place = int(ast.get_docstring(node) is not None)
        node.body[place:place] = [item.body[0] for item in read]
        self._read, self._own = outer, own
        return node

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return self._variable(node) if isinstance(node.ctx, ast.Load) else node

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        found = self._variable(node)
        return self.generic_visit(node) if found is node else found

    def _variable(self, node: ast.expr) -> ast.AST:
        name = self._known.get(_dotted(node))
        if self._read is None or name not in self._all.kinds or name in self._all.reasons:
            return node
        if isinstance(node, ast.Name) and node.id in self._own:
            return node
        self._all.used.add(name)
        alias = f"_slot_{self._all.slots[name]}"
        self._read[alias] = name
        return ast.Name(alias, ast.Load())


def _dotted(node: ast.AST) -> str:
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        return f"{node.value.id}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def _assigned(tree: ast.Module) -> Iterator[str]:
    """Names that a module gives numbers to."""
    for node in tree.body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
            for item in ast.walk(target):
                if isinstance(item, ast.Name) and CONSTANT.fullmatch(item.id):
                    yield item.id


def run(units: Mapping[str, Unit]) -> dict[str, tuple[Figures, str]]:
    """Figures and digest of each unit; an exception is a figure, too."""
    return {name: _outcome(unit) for name, unit in units.items()}


def _outcome(unit: Unit) -> tuple[Figures, str]:
    try:
        return unit()
    except Exception as error:  # noqa: BLE001 - whatever is raised is a result
        return {type(error).__name__: 1}, type(error).__name__


def tried(
    slot: int, value: float, units: Mapping[str, Unit], seconds: float
) -> dict[str, tuple[Figures, str]] | str:
    """The units' results with another value of a constant, or how the process ended."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        resource.setrlimit(resource.RLIMIT_AS, (_memory() + MEMORY_LIMIT, resource.RLIM_INFINITY))
        MEMORY[slot, 0] = value
        forget()
        with os.fdopen(writer, "wb") as pipe:
            pickle.dump(run(units), pipe)
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        ready = select.select([pipe], [], [], min(seconds, 1e6))[0]
        if not ready:
            os.kill(child, signal.SIGKILL)
        data = pipe.read()
    status = os.waitpid(child, 0)[1]
    if not ready:
        return "no end"
    return pickle.loads(data) if data and not status else "crash"  # noqa: S301


def _memory() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * mmap.PAGESIZE


def usual(units: Mapping[str, Unit]) -> tuple[dict[str, tuple[Figures, str]], dict[str, set[int]]]:
    """The units' results with the usual values, and the slots that each of them reads."""
    found, read = {}, {}
    for name, unit in units.items():
        MEMORY[:, 1] = 0.0
        forget()
        found |= run({name: unit})
        read[name] = set(map(int, np.flatnonzero(MEMORY[:, 1])))
    return found, read


def forget() -> None:
    """Clear what the package's functions keep of earlier calls."""
    for item in _caches():
        item.cache_clear()


@functools.cache
def _caches() -> list[Any]:
    found = [item for item in gc.get_objects() if isinstance(item, CACHE)]
    return [item for item in found if item.__module__.startswith(ROOT)]


def changed(kind: type, value: float, factor: float) -> float:
    """The value times the factor; a whole number stays one."""
    return float(int(value * factor)) if kind is int else value * factor


def measure(
    constants: Constants, units: Mapping[str, Unit], rare: str, only: str, output: Path
) -> None:
    """Append a line of JSON for each constant that the file does not have yet."""
    known = {tuple(item["name"]) for item in _lines(output)}
    before, read = usual(units)
    began = perf_counter()
    repeated = tried(0, MEMORY[0, 0], units, math.inf)
    seconds = perf_counter() - began
    unstable = [name for name in units if repeated[name][1] != before[name][1]]
    print(f"{len(units)} units in {seconds:.1f} s; not repeatable: {unstable}", flush=True)
    gc.freeze()
    for name, slot in constants.slots.items():
        module, text = ".".join(name), {}
        if not re.search(only, module) or name in known or name not in constants.kinds:
            continue
        value = float(MEMORY[slot, 0])
        mine = {key: units[key] for key in units if slot in read[key] and key not in unstable}
        if 2 * len(mine) > len(units):
            mine = {key: unit for key, unit in mine.items() if not key.startswith(rare)}
        if name in constants.reasons or name not in constants.used:
            text["not measured"] = constants.reasons.get(name, "no function reads it")
        elif not mine:
            text["not measured"] = "not reached"
        else:
            limit = LEAST_TIME_S + TIME_RATIO * seconds * len(mine) / len(units)
            few, many = (_some(mine, most) for most in (FEW_UNITS, MANY_UNITS))
            for chosen, labels in ((few, ("half", "twice")), (many, ("zero", "huge"))):
                if any(text.values()):
                    break
                for label in labels:
                    other = changed(constants.kinds[name], value, CHANGES[label])
                    after = tried(slot, other, chosen, limit) if other != value else {}
                    text[label] = after if isinstance(after, str) else compared(before, after)
        with output.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"name": name, "value": value, "units": len(mine)} | text) + "\n")
        print(".".join(name), value, len(mine), text, flush=True)


def _some(units: Mapping[str, Unit], most: int) -> dict[str, Unit]:
    return dict(itertools.islice(units.items(), 0, None, math.ceil(len(units) / most)))


def compared(
    before: Mapping[str, tuple[Figures, str]], after: Mapping[str, tuple[Figures, str]]
) -> str:
    """What changed, in words; empty where every result is equal to the last bit.

    Figures are counts, or sums of squares and how many: their root mean squares are compared.
    """
    if all(before[name][1] == after[name][1] for name in after):
        return ""
    totals: list[dict[str, Any]] = []
    for results in (before, after):
        total: dict[str, Any] = {}
        for name in after:
            for key, value in results[name][0].items():
                total[key] = np.add(total.get(key, 0 * np.asarray(value)), value)
        totals.append(total)
    words = []
    for key in dict.fromkeys([*totals[0], *totals[1]]):
        old, new = (np.asarray(total.get(key, 0.0)) for total in totals)
        if old.ndim or new.ndim:
            old, new = (_root_mean(item) for item in (old, new))
            if abs(new / old - 1) >= LEAST_RATIO:
                words.append(f"{key} {new / old - 1:+.1%}")
        elif old != new:
            words.append(f"{key} {int(new - old):+d}")
    return ", ".join(words) or f"less than {LEAST_RATIO:.2%}"


def _root_mean(squares: Any) -> Any:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(squares[0] / squares[1]) if squares.ndim else np.float64("nan")


def _lines(output: Path) -> list[dict[str, Any]]:
    return [json.loads(item) for item in output.read_text().splitlines()] if output.exists() else []


def write_tables(path: Path, results: list[dict[str, Any]]) -> None:
    """One table for each module, in place of what the file has of it; the others stay."""
    before = path.read_text(encoding="utf-8").split("\n## ")[1:] if path.exists() else []
    tables = {text.partition("\n")[0]: text.rstrip("\n") for text in before}
    for module in dict.fromkeys(item["name"][0] for item in results):
        name = module.removeprefix(ROOT + ".")
        lines = [name, "", head("constant", "value", "units", *CHANGES)]
        for item in sorted((i for i in results if i["name"][0] == module), key=itemgetter("name")):
            cells = [item[key] or "-" if key in item else "" for key in CHANGES]
            cells[0] = item.get("not measured", cells[0])
            lines.append(line(item["name"][1], f"{item['value']:g}", item["units"], *cells))
        tables[name] = "\n".join(lines)
    text = "\n\n## ".join([HEADER, *(tables[name] for name in sorted(tables))])
    path.write_text(text + "\n", encoding="utf-8")


def main() -> None:
    """Measure, and write the table."""
    parser = CommandLine(__doc__)
    parser.add_argument("score", choices=("tracking", "force"))
    parser.option("--only", "regular expression of module.NAME", r"")
    parser.option("--data", "folder of sample frames with truth", type=Path)
    parser.option("--output", "table", Path("benchmark_output/constants.md"), type=Path)
    options = parser.parse_args()
    for variable in ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ[variable] = "1"
    constants = Constants()
    sources = "".join(path.read_text() for path in constants.sources.values())
    digest = hashlib.sha256(sources.encode()).hexdigest()[:16]
    os.environ["NUMBA_CACHE_DIR"] = str(Path("benchmark_output").resolve() / f"constants-{digest}")
    compile_reading()
    sys.meta_path.insert(0, constants)
    scores = importlib.import_module("constant_scores")
    frames = Path(f"benchmark_output/constants-{options.score}.pickle")
    frames.parent.mkdir(exist_ok=True)
    rows = frames.with_suffix(".jsonl")
    if not frames.exists():
        frames.write_bytes(pickle.dumps(scores.UNITS[options.score](options.data)))
    units = pickle.loads(frames.read_bytes())  # noqa: S301
    measure(constants, units, scores.RARE, options.only, rows)
    write_tables(options.output, _lines(rows))


if __name__ == "__main__":
    main()
