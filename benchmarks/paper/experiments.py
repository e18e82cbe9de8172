"""All experiments, in the order of the page."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

from paper.experiment import Experiment

__all__ = ["EXPERIMENTS"]

_KEYS = (
    "objects",
    "precision",
    "resolution",
    "reliability",
    "speed",
    "balls",
    "probe",
    "grasp",
    "density",
    "pattern_choice",
)


def _present() -> tuple[Experiment, ...]:
    names = (f"paper.{key}_report" for key in _KEYS)
    return tuple(import_module(name).EXPERIMENT for name in names if find_spec(name))


EXPERIMENTS = _present()
