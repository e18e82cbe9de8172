"""Frictional contact of a rigid indenter on the condensed compliance of a gel.

Signorini's and Coulomb's laws at all nodes are one non-smooth equation (Alart and Curnier 1991),
solved by Newton's method: each iteration knows which nodes are open, which stick and which
slide, takes normals and gaps at the nodes' latest places, and solves for the rest.  The same
system holds the indenter's motion where the load is given instead of the place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_simulation.contact.laws import TINY, Problem, View, law_residual, look, on_cone
from cmp_tactile_simulation.contact.newton import (
    CONTACT_ARM,
    Flips,
    NotConvergedError,
    first_status,
    missed_load,
    newton_step,
    status_of,
)
from cmp_tactile_simulation.contact.pose import Pose
from cmp_tactile_simulation.contact.settings import ContactSettings

__all__ = [
    "CONTACT_ARM",
    "Guess",
    "NotConvergedError",
    "Problem",
    "Solution",
    "solve",
    "way_between",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A step under load that needs more than this many times the longest step is cut short.
LONGEST_WAY = 4.0
# Solved forces are put on the cone until they change by less than this share.
CONE_TOLERANCE = 1e-13
CONE_PASSES = 60
# While friction exceeds the cone by more than this share of the largest force, the iteration
# goes on.
CONE_EXCESS = 1e-10
# A node whose friction is this near to the cone slides.
EDGE_SHARE = 1e-6


@dataclass(frozen=True)
class Guess:
    """Where the iteration begins: forces (k, 3) N, the pose, and which nodes slide (k,)."""

    force: Array
    pose: Pose
    sliding: Mask


@dataclass(frozen=True)
class Solution:
    """A solved step; arrays of the k nodes.  place: deformed positions, m, gel frame."""

    force: Array
    pose: Pose
    place: Array
    sliding: Mask


def solve(
    problem: Problem,
    guess: Guess,
    offset: Array,
    load: Array | None,
    settings: ContactSettings,
) -> Solution:
    """Forces and places at the end of a step.

    offset: (k, 3) m, what the displacement holds beyond the linear model.
    load: (4,) force on the gel along x, y, z, N, and torque about z through the indenter's
    origin, N m, to be reached by moving from the guessed pose; None keeps that pose.  Without
    friction only z is moved, and the rest of the load does not count.
    Raises NotConvergedError.
    """
    rest = problem.rest + offset
    view = look(problem, rest, guess.force, guess.pose)
    status = first_status(problem, view, guess.sliding)
    flips = Flips(len(rest))
    best, residual = view, np.inf
    for iteration in range(settings.iterations):
        force, pose = newton_step(problem, view, status, load)
        if load is not None and way_between(guess.pose, pose) > LONGEST_WAY * settings.step:
            raise NotConvergedError(np.inf)
        if iteration >= settings.iterations // 2:
            force = (view.force + force) / 2
        view = look(problem, rest, force, pose)
        found = _residual(problem, view, flips, settings)
        if found < residual and missed_load(problem, view, load) < settings.load_tolerance:
            best, residual = view, found
            if residual < settings.tolerance:
                polished = _polished(problem, rest, view)
                if _excess(problem, polished) < CONE_EXCESS:
                    return _finished(problem, polished, settings)
        status = flips.hold(status_of(problem, view))
    if residual > settings.accepted:
        raise NotConvergedError(residual)
    return _finished(problem, _polished(problem, rest, best), settings)


def _residual(problem: Problem, view: View, flips: Flips, settings: ContactSettings) -> float:
    """Largest distance from the laws, m, but for nodes that are held."""
    signorini, coulomb = law_residual(problem, view)
    coulomb[flips.held & (coulomb < settings.flip_tolerance)] = 0.0
    return float(max(signorini.max(), coulomb.max()))


def way_between(begin: Pose, end: Pose) -> float:
    """How far a motion takes the points of a contact about, m."""
    turn = Rotation.from_matrix(end.rotation @ begin.rotation.T).magnitude()
    return float(np.linalg.norm(end.position - begin.position) + CONTACT_ARM * turn)


def _polished(problem: Problem, rest: Array, view: View) -> View:
    """The view with its forces put on the cone, as nearly as what that moves allows."""
    change = np.inf
    for _ in range(CONE_PASSES):
        force = on_cone(problem, view)
        before, change = change, float(np.abs(force - view.force).max())
        # On an edge without a stable place the passes would lead away from the solution.
        if change > before:
            break
        view = look(problem, rest, force, view.pose)
        if change <= CONE_TOLERANCE * np.abs(force).max():
            break
    return view


def _excess(problem: Problem, view: View) -> float:
    """How far friction exceeds the cone, as a share of the largest normal force."""
    beyond = np.linalg.norm(view.along, axis=1) - problem.friction * view.pressing
    return float(beyond.max(initial=0.0) / max(view.pressing.max(initial=0.0), TINY))


def _finished(problem: Problem, view: View, settings: ContactSettings) -> Solution:
    residual = float(max(part.max() for part in law_residual(problem, view)))
    if residual > max(settings.accepted, settings.flip_tolerance):
        raise NotConvergedError(residual)
    size = np.linalg.norm(view.along, axis=1)
    edge = (1 - EDGE_SHARE) * problem.friction * view.pressing
    return Solution(view.force, view.pose, view.place, (view.pressing > 0) & (size >= edge))
