"""What the indenter of a live sensor may be asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.pose import Pose
from cmp_tactile_simulation.contact.state import Load
from cmp_tactile_simulation.errors import CommandError

__all__ = ["Command", "Reset", "check_command"]

HIGHEST_M = 0.1
ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Reset:
    """Back to the beginning of the scene, the gel at rest."""


Command = Pose | Load | Reset
"""Go to a pose and stay there; press with a load and stay so; begin again."""


def check_command(command: Command, sensor: SensorDescription) -> None:
    """Raise CommandError for what is no pose, out of reach of the gel, or no load into it."""
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
        msg = "found no rotation, expected a proper one"
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
        msg = f"force.z: found {-load.normal:g} N, expected less than 0: into the gel"
        raise CommandError(msg)
