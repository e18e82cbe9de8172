"""Draw the rooms of all packages, floor by floor, as `make check` holds them.

usage: rooms.py [PICTURE]   (Python 3.11 or newer)

The floors come from the contracts in pyproject.toml; a room imports only from floors below its own.
"""

from __future__ import annotations

import sys
from pathlib import Path

import tomllib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "images" / "rooms.png"
# Whatever stands higher, or to the left, may import what stands lower, or to the right.
COLUMNS = (
    ("cmp_tactile_bringup", "cmp_tactile_simulation", "cmp_tactile_viewer"),
    ("cmp_tactile_driver", "cmp_tactile_processing"),
)
COLOURS = {
    "cmp_tactile_bringup": "#8a6d3b",
    "cmp_tactile_simulation": "#7a5195",
    "cmp_tactile_viewer": "#b3562b",
    "cmp_tactile_driver": "#2f6f8f",
    "cmp_tactile_processing": "#2e7d5b",
}
WIDTH, HEIGHT, GAP, TITLE = 7.0, 0.38, 0.08, 0.42


def floors_of(package: str) -> list[list[str]]:
    """Rooms of a package, floor by floor, the highest first."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    for contract in settings["tool"]["importlinter"]["contracts"]:
        if contract.get("containers") == [package]:
            floors = contract["layers"]
            return [
                [room.strip() for room in floor.replace(":", "|").split("|")] for floor in floors
            ]
    msg = f"pyproject.toml: found no floors of {package}"
    raise LookupError(msg)


def modules_in(package: str, room: str) -> int:
    """Number of modules of a room, itself where it is a single one."""
    folder = ROOT / package / package / room
    return sum(path.name != "__init__.py" for path in folder.rglob("*.py")) or 1


def main() -> None:
    """Draw and save."""
    height = max(map(_height_of, COLUMNS))
    width = len(COLUMNS) * WIDTH
    figure = Figure(figsize=(width, height), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(-height, 0))
    axes.axis("off")
    for number, packages in enumerate(COLUMNS):
        top = 0.0
        for package in packages:
            left = number * WIDTH + 3 * GAP
            axes.text(left, top - 0.3, package, fontsize=13, color=COLOURS[package])
            top -= TITLE
            for floor in floors_of(package):
                _draw_floor(axes, package, floor, (number * WIDTH + 2 * GAP, top))
                top -= HEIGHT + GAP
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else PICTURE)


def _height_of(packages: tuple[str, ...]) -> float:
    return sum(TITLE + len(floors_of(item)) * (HEIGHT + GAP) for item in packages) + GAP


def _draw_floor(axes: Axes, package: str, floor: list[str], corner: tuple[float, float]) -> None:
    left, top = corner
    width = (WIDTH - 4 * GAP) / len(floor)
    for number, room in enumerate(floor):
        start = left + number * width
        box = FancyBboxPatch(
            (start + GAP / 2, top - HEIGHT),
            width - GAP,
            HEIGHT,
            boxstyle="round,pad=0,rounding_size=0.06",
            facecolor=COLOURS[package],
            alpha=0.85,
            linewidth=0,
        )
        axes.add_patch(box)
        text = f"{room}  {modules_in(package, room)}"
        middle = start + width / 2, top - HEIGHT / 2
        axes.text(*middle, text, ha="center", va="center", fontsize=10, color="white")


if __name__ == "__main__":
    main()
