"""V.D: the grasp of a hexagonal wrench with a knock, and knocks of any size; the cases."""

from __future__ import annotations

from paper.experiment import Case, Workplace
from paper.grasp_film import film_grasp
from paper.grasp_scene import DIRECTIONS
from paper.knock import knocks

__all__ = ["PRINTS", "SIZES", "cases"]

PRINTS = ("cmp", "dmp")
SEEDS = 3
# Pitches from one frame to the next.
SIZES = (0.2, 0.4, 0.45, 0.5, 0.55, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0)
FAST_SIZES = (0.4, 0.8, 2.0)


def cases(place: Workplace) -> list[Case]:
    """The grasp and the knocks, each once for a print; the quick run has one direction."""
    seeds = 1 if place.fast else SEEDS
    found = [Case(f"grasp-{p}", film_grasp, (p, seeds), 20 if place.fast else 60) for p in PRINTS]
    if place.fast:
        along = DIRECTIONS[0]
        quick = [
            Case(f"knock-{along.name}-{p}", knocks, (p, along, FAST_SIZES), 12) for p in PRINTS
        ]
        return found + quick
    for p in PRINTS:
        found += [Case(f"knock-{d.name}-{p}", knocks, (p, d, SIZES), 50) for d in DIRECTIONS]
    return found
