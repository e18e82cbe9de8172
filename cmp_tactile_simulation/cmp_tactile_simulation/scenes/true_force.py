"""The true contact force of a simulated contact, as the force stage would return it."""

from __future__ import annotations

import numpy as np

from cmp_tactile_processing.measured.force_field import ForceField, SlipEstimate, SlipState
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.state import ContactState

__all__ = ["force_field", "slip_estimate", "slip_state"]


def force_field(
    contact: ContactSimulation, state: ContactState, sensor: SensorDescription
) -> ForceField:
    """Force of a contact that it solved on the gel, gel frame, on all contact nodes.

    position: the undeformed nodes.  wrench: about the gel frame's origin, the forces acting at
    the nodes' deformed positions, so that it is what a force-torque sensor would show.
    centre_of_pressure: mean of the deformed positions of the nodes that touch, weighted by the
    force along z, (3,) m.  contact_area: undeformed area of these nodes.
    """
    elastomer = contact.elastomer
    place = elastomer.node_position + state.displacement
    moment = np.cross(place, state.force).sum(axis=0)
    centre = np.full(3, np.nan)
    weight = state.force[:, 2]
    if state.contact.any() and weight.sum() != 0:
        centre = weight @ place / weight.sum()
    slip = slip_estimate(contact, state)
    return ForceField(
        rows=elastomer.nodes.rows,
        cols=elastomer.nodes.cols,
        position=elastomer.node_position,
        force=state.force,
        contact=state.contact,
        wrench=np.concatenate([state.resultant, moment]),
        contact_area=float(elastomer.node_area[state.contact].sum()),
        centre_of_pressure=centre,
        reference_point=np.zeros(3),
        slip_state=slip.state,
        slip=slip,
        valid_fraction=1.0,
        regularization=0.0,
        young=sensor.elastomer.young,
        poisson=sensor.elastomer.poisson,
    )


def slip_estimate(contact: ContactSimulation, state: ContactState) -> SlipEstimate:
    """What slides in a solved contact: exact, with Coulomb's coefficient where anything slides.

    traction_ratio: across over along the mean normal of the indenter where it touches, weighted
    by pressing force.
    """
    what, touches = slip_state(state), state.contact
    if what is SlipState.NO_CONTACT:
        return SlipEstimate(what)
    place = contact.elastomer.node_position[touches] + state.displacement[touches]
    force, slipping = state.force[touches], state.slipping[touches]
    normal = contact.indenter.distance(state.pose.to_indenter(place))[1] @ state.pose.rotation.T
    pressing = (force * normal).sum(axis=1)
    mean = pressing @ normal / np.linalg.norm(pressing @ normal)
    total = force.sum(axis=0)
    along = total - (total @ mean) * mean
    slides = bool(slipping.any())
    return SlipEstimate(
        state=what,
        slip_ratio=float(pressing[slipping].sum() / pressing.sum()),
        traction_ratio=float(np.linalg.norm(along) / (total @ mean)),
        friction_coefficient=contact.friction if slides else float("nan"),
        friction_std=0.0 if slides else float("nan"),
    )


def slip_state(state: ContactState) -> SlipState:
    """No contact, or whether none, some or all of the nodes that touch slide."""
    touching, sliding = int(state.contact.sum()), int(state.slipping.sum())
    if touching == 0:
        return SlipState.NO_CONTACT
    if sliding == 0:
        return SlipState.STICK
    return SlipState.FULL if sliding == touching else SlipState.INCIPIENT
