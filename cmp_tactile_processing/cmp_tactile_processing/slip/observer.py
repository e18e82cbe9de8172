"""Stick and slip of the contacts, and their friction, frame by frame."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from math import hypot, sqrt
from statistics import median

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import (
    MAD_TO_STD,
    Contact,
    ForceField,
    SlipEstimate,
    SlipState,
    Surface,
)
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import SlipParameters
from cmp_tactile_processing.slip.friction import (
    ContactPatch,
    FrictionUse,
    TractionRecord,
    patch_of,
)
from cmp_tactile_processing.slip.surface_motion import ContactSurface

# Once the normal force has grown by this factor, it is tested whether the tangential force has
# grown with it.
MIN_NORMAL_GROWTH = 1.05
# Nothing has slid if the tangential force grew less steeply than this many times the present ratio.
MAX_STICKING_STEEPNESS_RATIO = 1.2
# Sliding is revoked if the friction ratio later rises by more than this share: a sliding contact
# cannot carry more.
REVOKED_ABOVE_SHARE = 0.1
# Sliding has ended and the load has reversed if the friction ratio falls by this share.
MIN_RELEASED_SHARE = 0.07
# Spread of traction over that of pressure; a smaller ratio is not explained by slip.
MIN_WIDTH_RATIO = 0.8
# The ratio of traction to pressure is not uniform if their widths differ by more than this share.
MAX_UNIFORM_WIDTH_DIFFERENCE = 0.15
# The friction ratio is steady if over so many frames it changes by at most this share.
STEADY_FRAMES = 3
MAX_STEADY_CHANGE = 0.02
# Radii by which a contact may travel over the gel before its history is no longer its own.
FARTHEST = 0.5
# Sliding frames that the friction coefficient is computed from.
MAX_SLIDING_FRAMES = 30
# Relative error of the friction coefficient beside noise: of a contact that slides as a whole,
SLIDING_ERROR_SHARE = 0.025
# and predicted while its core sticks.
PREDICTED_ERROR_SHARE = 0.1
# Slip ratio above which the friction coefficient of the rim is reported.
MIN_PREDICTED_SLIP_RATIO = 0.5
DEVIATIONS = 3.0

UNKNOWN = SlipEstimate()

# Contacts are the same if they have at least this share of their nodes in common.
MIN_COMMON_NODES_SHARE = 0.3
# The history of a contact is kept over at most this many frames without it, or without the surface.
MAX_MISSED_FRAMES = 5
# Share of the measured markers around a contact's nodes below which its slip is not determined.
LEAST_KNOWN = 0.7
# An unknown contact with less than this share of the normal force does not make all unknown.
MAX_IGNORED_FORCE_SHARE = 0.1


class ContactTrack:
    """The friction history of one contact."""

    def __init__(self, parameters: SlipParameters) -> None:
        self._parameters = parameters
        self.mask: NDArray[np.bool_] | None = None
        self.missed = 0
        self._forget()

    def use(self, parameters: SlipParameters) -> None:
        """Judge the next frames by these; what is known of earlier ones stays."""
        self._parameters = parameters

    def _forget(self) -> None:
        self._begun = False
        self._anchor: TractionRecord | None = None
        self._level: tuple[float, NDArray[np.float64]] = (0.0, np.zeros(3))
        self._known = False  # whether it is known that not all slid at the anchor
        self._peak: tuple[float, float, TractionRecord] | None = None
        self._recent: deque[float] = deque(maxlen=STEADY_FRAMES)
        self._sliding = False
        self._slid: deque[float] = deque(maxlen=MAX_SLIDING_FRAMES)
        self._friction = float("nan")

    def judge(self, patch: ContactPatch | None) -> SlipEstimate:
        """The slip of this contact in the next frame; None: it cannot be seen in it."""
        if patch is None:
            return UNKNOWN
        if patch.normal_force < self._parameters.min_normal_force:
            self._forget()
            return UNKNOWN
        if not self._begun:
            self._begun = True
            self._anchor_at(patch, known=False)
        estimate = self._judge(patch)
        self._recent.append(patch.use.ratio)
        return replace(estimate, traction_ratio=patch.traction_ratio)

    def _judge(self, patch: ContactPatch) -> SlipEstimate:
        if self._sliding:
            if patch.use.ratio > self._friction_at_most(patch):
                self._sliding, self._peak, self._friction = False, None, float("nan")
                self._slid.clear()
            elif patch.use.ratio >= self._friction_kept(patch):
                return self._slides(patch)
            else:
                self._sliding = False
                if self._peak is not None:
                    self._anchor, self._known, self._peak = self._peak[2], True, None
        self._follow(patch)
        assert self._anchor is not None  # noqa: S101  there is one since the first frame
        reach = patch.since(self._anchor)
        if self._turned(patch, reach):
            reach = patch.since(self._anchor)
        self._keep_peak(patch, reach)
        return self._estimate(patch, reach)

    def _friction_kept(self, patch: ContactPatch) -> float:
        return (1 - MIN_RELEASED_SHARE) * self._friction - DEVIATIONS * patch.ratio_std

    def _friction_at_most(self, patch: ContactPatch) -> float:
        return (1 + REVOKED_ABOVE_SHARE) * self._friction + DEVIATIONS * patch.ratio_std

    def _slides(self, patch: ContactPatch) -> SlipEstimate:
        self._sliding = True
        self._slid.append(patch.use.ratio)
        self._friction = median(self._slid)
        scatter = MAD_TO_STD * median(abs(ratio - self._friction) for ratio in self._slid)
        error = SLIDING_ERROR_SHARE * self._friction
        std = hypot(scatter / sqrt(len(self._slid)), patch.ratio_std, error)
        self._peak = patch.use.ratio, 0.0, patch.record()
        return SlipEstimate(SlipState.FULL, 1.0, 0.0, self._friction, std)

    def _anchor_at(self, patch: ContactPatch, *, known: bool) -> None:
        small = patch.use.ratio < self._parameters.min_traction_ratio
        self._anchor, self._peak = patch.record(small=small), None
        self._known = known or small
        self._level_at(patch)

    def _level_at(self, patch: ContactPatch) -> None:
        self._level = patch.normal_force, patch.along.sum(axis=0)

    def _follow(self, patch: ContactPatch) -> None:
        """Count from now where the tangential force grew only along with the normal force."""
        normal, along = self._level
        least = self._parameters.min_traction_ratio
        if patch.normal_force >= MIN_NORMAL_GROWTH * normal:
            rise = float(np.linalg.norm(patch.along.sum(axis=0) - along))
            steepness = rise / (patch.normal_force - normal)
            if steepness < MAX_STICKING_STEEPNESS_RATIO * max(patch.use.ratio, least):
                below = patch.use.ratio < (1 - MIN_RELEASED_SHARE) * self._friction
                self._anchor_at(patch, known=self._known or bool(below))
            self._level_at(patch)
        elif patch.normal_force < normal:
            self._level_at(patch)

    def _turned(self, patch: ContactPatch, reach: FrictionUse) -> bool:
        """Count from the largest load where so much of it was given back."""
        if self._peak is None:
            return False
        ratio, load, record = self._peak
        lost = max(MIN_RELEASED_SHARE * ratio, DEVIATIONS * patch.ratio_std)
        enough = ratio > self._parameters.min_traction_ratio
        turned = enough and reach.ratio < ratio - lost and reach.ratio * patch.normal_force < load
        if turned:
            self._anchor, self._known, self._peak = record, True, None
        return turned

    def _keep_peak(self, patch: ContactPatch, reach: FrictionUse) -> None:
        if self._peak is None or reach.ratio >= self._peak[0]:
            self._peak = reach.ratio, reach.ratio * patch.normal_force, patch.record()

    def _estimate(self, patch: ContactPatch, reach: FrictionUse) -> SlipEstimate:
        if patch.use.ratio >= self._friction_kept(patch):
            return self._slides(patch)
        if reach.ratio < max(self._parameters.min_traction_ratio, DEVIATIONS * patch.ratio_std):
            uneven = abs(patch.use.width - 1) > MAX_UNIFORM_WIDTH_DIFFERENCE
            known = self._known or uneven
            return SlipEstimate(SlipState.STICK, 0.0) if known else UNKNOWN
        if not self._shows(patch, reach):
            return UNKNOWN
        slip_ratio, used = patch.profile.at(reach)
        if slip_ratio >= self._parameters.full_ratio:
            if self._is_steady(patch):
                return self._slides(patch)
        else:
            self._known = True
            if slip_ratio < self._parameters.incipient_ratio:
                return SlipEstimate(SlipState.STICK, slip_ratio)
        friction = std = float("nan")
        if np.isfinite(self._friction):
            friction, std = self._friction, SLIDING_ERROR_SHARE * self._friction
        elif slip_ratio >= MIN_PREDICTED_SLIP_RATIO and self._from_nothing:
            friction = reach.ratio / used
            std = float(np.hypot(PREDICTED_ERROR_SHARE * friction, patch.ratio_std))
        return SlipEstimate(SlipState.INCIPIENT, slip_ratio, 0.0, friction, std)

    @property
    def _from_nothing(self) -> bool:
        """Whether the friction used is counted from where none was in use."""
        return self._anchor is not None and self._anchor.along is None

    def _shows(self, patch: ContactPatch, reach: FrictionUse) -> bool:
        """Whether the spread of what has changed shows how far slip has gone."""
        anchor = self._anchor
        travelled = 0.0 if anchor is None else float(np.linalg.norm(patch.centre - anchor.centre))
        near = travelled < FARTHEST * patch.radius
        return near and patch.profile.is_rounded and reach.width > MIN_WIDTH_RATIO

    def _is_steady(self, patch: ContactPatch) -> bool:
        """Whether the friction used stays as it is and, where it once slid, is as high as then.

        It falls where a contact that does not slide is pressed harder.
        """
        if len(self._recent) < STEADY_FRAMES or patch.use.ratio < self._friction_kept(patch):
            return False
        limit = max(MAX_STEADY_CHANGE * patch.use.ratio, DEVIATIONS * patch.ratio_std)
        return max(abs(patch.use.ratio - before) for before in self._recent) < limit


class SlipObserver:
    """The slip of each contact from force fields of consecutive frames (see docs/slip.md).

    It counts on no rate and no equal time steps: what matters is the order of loads.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self._parameters = sensor.slip
        self._surface = ContactSurface(sensor)
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
        """The field with slip, slip_state and every contact's slip filled in.

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
        filled = tuple(
            replace(contact, slip=slip)
            for contact, slip in zip(field.contacts, slips[: len(field.contacts)], strict=True)
        )
        return replace(field, contacts=filled, slip=summed, slip_state=summed.state)

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
            if shares and max(shares) >= MIN_COMMON_NODES_SHARE:
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
        self._tracks = [track for track in tracks if track.missed <= MAX_MISSED_FRAMES]


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
    """All contacts together: means weighted by normal force of those that are known."""
    if len(slips) == 1:
        return slips[0]
    weight = np.maximum(normal_force, 0.0)
    states = np.array([slip.state for slip in slips])
    known = states != SlipState.UNKNOWN
    sliding = (states == SlipState.FULL) | (states == SlipState.INCIPIENT)
    if not known.any() or (
        weight[~known].sum() > MAX_IGNORED_FORCE_SHARE * weight.sum() and not sliding.any()
    ):
        state = SlipState.UNKNOWN
    elif (states[known] == SlipState.FULL).all():
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
