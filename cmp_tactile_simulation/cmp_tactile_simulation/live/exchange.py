"""What a live sensor is asked for, and what it answers: commands; frames with status and truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from cmp_tactile_driver.sources.frames import Frame
from cmp_tactile_processing.measured import ForceField, Grid, Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.laws import Load, Pose
from cmp_tactile_simulation.errors import CommandError

HIGHEST_M = 0.1
ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Reset:
    """Back to the beginning of the scene, the gel at rest."""


Command = Pose | Load | Reset
"""Go to a pose and stay there; press with a load and stay so; begin again."""


def check_command(command: Command, sensor: SensorDescription) -> None:
    """Raise CommandError for an invalid pose or one out of reach, or a load not into the gel."""
    if isinstance(command, Pose):
        _check_pose(command, sensor)
    elif isinstance(command, Load):
        _check_load(command)


def _check_pose(pose: Pose, sensor: SensorDescription) -> None:
    if not (np.isfinite(pose.position).all() and np.isfinite(pose.rotation).all()):
        msg = "found a number that is not finite, expected a pose"
        raise CommandError(msg)
    error = np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max()
    if error > ROTATION_TOLERANCE or np.linalg.det(pose.rotation) < 0:
        msg = "found a matrix that is not a rotation, expected a proper rotation"
        raise CommandError(msg)
    x, y, thickness = sensor.elastomer.size
    limits = ((-x / 2, x / 2), (-y / 2, y / 2), (-thickness, HIGHEST_M))
    for name, value, (low, high) in zip("xyz", pose.position.tolist(), limits, strict=True):
        if not low <= value <= high:
            msg = f"position.{name}: found {value:g} m, expected {low:g} to {high:g} m"
            raise CommandError(msg)


def _check_load(load: Load) -> None:
    values = (load.normal, *load.tangential, load.torque)
    if not all(map(math.isfinite, values)):
        msg = f"found force and torque {values}, expected finite numbers"
        raise CommandError(msg)
    if load.normal <= 0:
        msg = f"force.z: found {-load.normal:g} N, expected less than 0 (into the gel)"
        raise CommandError(msg)


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
    """What is reported of a frame beside its picture.

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
