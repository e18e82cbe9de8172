"""A frame of a live sensor, and what is true of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from cmp_tactile_driver.sources.frames import Frame
from cmp_tactile_processing.measured.force_field import ForceField
from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_simulation.contact.pose import Pose

__all__ = ["LiveFrame", "LiveMode", "LiveStatus", "TruthWanted"]


class LiveMode(Enum):
    """What the indenter does."""

    BUILDING = "building the elastic model"
    PLAYING = "playing the scene"
    MOVING = "moving to the target"
    PRESSING = "pressing with the load"
    HOLDING = "holding still"


@dataclass(frozen=True)
class LiveStatus:
    """How a live sensor is.

    note: how far the elastic model is built.  problem: why the last step could not be solved, or
    empty.  steps: states that were solved so far.  step_s: how long one takes to solve, averaged
    over the last ones, s.
    """

    mode: LiveMode = LiveMode.BUILDING
    note: str = ""
    problem: str = ""
    steps: int = 0
    step_s: float = 0.0


@dataclass(frozen=True)
class TruthWanted:
    """What is to be told of a frame beside its picture.

    force: the force field.  optics: grids and surface.
    """

    force: bool = False
    optics: bool = False


@dataclass(frozen=True)
class LiveFrame(Frame):
    """A frame, how the sensor is, and what was wanted of its truth.

    pose: of the indenter; None for the gel at rest before there is a state, which has no force
    field either.  grids: by view, px of the view.
    """

    status: LiveStatus
    pose: Pose | None = None
    force: ForceField | None = None
    grids: Mapping[str, Grid] | None = None
    surface: Surface | None = None
