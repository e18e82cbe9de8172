"""Stick and slip of the contacts, and their friction, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.force_field import Contact, ForceField, SlipEstimate, SlipState
from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import SlipParameters
from cmp_tactile_processing.slip.friction import compile_friction
from cmp_tactile_processing.slip.patch import ContactPatch, patch_of
from cmp_tactile_processing.slip.surface_motion import ContactSurface
from cmp_tactile_processing.slip.track import ContactTrack

__all__ = ["SlipObserver"]

# Share of nodes that a contact must have in common with an earlier one to be the same.
SAME_SHARE = 0.3
# Frames in which a contact, or the whole surface, may be lost and its history is kept.
FORGOTTEN_AFTER = 5
# Share of the measured markers around a contact's nodes below which its slip is not told.
LEAST_KNOWN = 0.7
# Contacts with less of the normal force than this do not make all of them unknown.
SLIGHT_SHARE = 0.1


class SlipObserver:
    """Tells the slip of each contact from force fields of consecutive frames (see docs/slip.md).

    It counts on no rate and no equal time steps: what matters is the order of loads.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self._parameters = sensor.slip
        self._surface = ContactSurface(sensor)
        compile_friction()
        self.reset()

    def reset(self) -> None:
        """Forget all contacts."""
        self._tracks: list[ContactTrack] = []
        self._reference_id: int | None = None

    def use(self, parameters: SlipParameters) -> None:
        """Judge by other parameters from the next frame on; contacts keep their history."""
        self._parameters = parameters
        for track in self._tracks:
            track.use(parameters)

    def update(self, field: ForceField, surface: Surface) -> ForceField:
        """The field with slip, slip_state and every contact's slip told.

        field, surface: of the same frame, later than that of the last call.  A field without
        contacts counts as one contact of all its contact nodes.
        """
        if surface.reference_id != self._reference_id:
            self.reset()
            self._reference_id = surface.reference_id
        if not np.isfinite(field.wrench).all():
            self._lose(self._tracks)
            return replace(field, slip=SlipEstimate(), slip_state=SlipState.UNKNOWN)
        contacts = field.contacts or _one_contact(field)
        if not contacts:
            self._tracks.clear()
            none = SlipEstimate(SlipState.NO_CONTACT)
            return replace(field, slip=none, slip_state=none.state)
        patches = self._patches(field, surface, contacts)
        slips = [
            track.judge(patch)
            for track, patch in zip(self._tracks_of(contacts, field), patches, strict=True)
        ]
        summed = _summed(slips, np.array([-contact.wrench[2] for contact in contacts]))
        told = tuple(
            replace(contact, slip=slip)
            for contact, slip in zip(field.contacts, slips[: len(field.contacts)], strict=True)
        )
        return replace(field, contacts=told, slip=summed, slip_state=summed.state)

    def _patches(
        self, field: ForceField, surface: Surface, contacts: Sequence[Contact]
    ) -> list[ContactPatch | None]:
        force = np.where(field.contact[:, None], field.force, 0.0)
        at = self._surface.at_nodes(surface, force)
        return [
            patch_of(contact, field.force, at)
            if at.known[contact.nodes].mean() >= LEAST_KNOWN
            else None
            for contact in contacts
        ]

    def _tracks_of(self, contacts: Sequence[Contact], field: ForceField) -> list[ContactTrack]:
        """The track of each contact: the one it shares most nodes with, or a new one."""
        free, found = list(self._tracks), []
        for contact in contacts:
            shares = [_overlap(track.mask, contact.nodes) for track in free]
            if shares and max(shares) >= SAME_SHARE:
                track = free.pop(int(np.argmax(shares)))
            else:
                track = ContactTrack(self._parameters)
                self._tracks.append(track)
            track.mask = np.zeros(field.contact.shape, np.bool_)
            track.mask[contact.nodes] = True
            track.missed = 0
            found.append(track)
        for track in free:
            self._tracks.remove(track)
        return found

    def _lose(self, tracks: Sequence[ContactTrack]) -> None:
        for track in tracks:
            track.missed += 1
        self._tracks = [track for track in tracks if track.missed <= FORGOTTEN_AFTER]


def _overlap(mask: NDArray[np.bool_] | None, nodes: NDArray[np.intp]) -> float:
    if mask is None or len(nodes) == 0:
        return 0.0
    return float(mask[nodes].sum()) / min(len(nodes), int(mask.sum()))


def _one_contact(field: ForceField) -> tuple[Contact, ...]:
    nodes = np.flatnonzero(field.contact)
    if len(nodes) == 0:
        return ()
    contact = Contact(
        nodes=nodes,
        wrench=field.wrench,
        covariance=field.wrench_covariance,
        area=field.contact_area,
        centre_of_pressure=field.centre_of_pressure,
        outline=np.empty((0, 3)),
        at_border=False,
    )
    return (contact,)


def _summed(slips: Sequence[SlipEstimate], normal_force: NDArray[np.float64]) -> SlipEstimate:
    """All contacts together: means weighted by normal force of those that are told."""
    if len(slips) == 1:
        return slips[0]
    weight = np.maximum(normal_force, 0.0)
    states = np.array([slip.state for slip in slips])
    told = states != SlipState.UNKNOWN
    sliding = (states == SlipState.FULL) | (states == SlipState.INCIPIENT)
    if not told.any() or (weight[~told].sum() > SLIGHT_SHARE * weight.sum() and not sliding.any()):
        state = SlipState.UNKNOWN
    elif (states[told] == SlipState.FULL).all():
        state = SlipState.FULL
    else:
        state = SlipState.INCIPIENT if sliding.any() else SlipState.STICK

    def mean(name: str) -> float:
        values = np.array([getattr(slip, name) for slip in slips])
        known = np.isfinite(values) & (weight > 0)
        return float(np.average(values[known], weights=weight[known])) if known.any() else np.nan

    return SlipEstimate(
        state,
        mean("slip_ratio"),
        mean("traction_ratio"),
        mean("friction_coefficient"),
        mean("friction_std"),
    )
