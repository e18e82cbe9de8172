"""What the page calls the readings: as their methods are called elsewhere on it."""

from __future__ import annotations

from paper.readings import Reading

__all__ = ["name_of"]


def name_of(reading: Reading) -> str:
    """The method's label, and which markers are taken."""
    if reading.method is None:
        return reading.label
    if reading.method.pattern_type == "dmp":
        return reading.method.label
    markers = "corners only" if reading.corners_only else "with virtual markers"
    return f"{reading.method.label}, {markers}"
