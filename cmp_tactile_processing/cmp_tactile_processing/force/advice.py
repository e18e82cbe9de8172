"""Slip state and flags of a ForceField in words: what is the matter, and what helps."""

from __future__ import annotations

from collections.abc import Iterator

from cmp_tactile_processing.measured import ForceFlag, SlipState

ADVICE: dict[ForceFlag, str] = {
    ForceFlag.FEW_MARKERS: (
        "too few markers are seen to determine a force: the trackers' diagnostics say why"
    ),
    ForceFlag.AT_BORDER: (
        "a load reaches the edge of the marker area: of what acts beyond it a part is counted, at "
        "the edge, and the rest is not; move the contact onto the markers before you measure"
    ),
    ForceFlag.BEYOND_MARKERS: (
        "something acts outside the marker area: force and moment are neither those of the whole "
        "load nor those of its part on the markers; move the contact onto the markers"
    ),
    ForceFlag.HIDDEN_CONTACT: (
        "markers under a contact or beside it are not seen: the force there is inferred from those "
        "around it"
    ),
    ForceFlag.NO_DEPTH: (
        "running without depth: the normal force is inferred from how the markers spread; seen "
        "aslant it may be wrong altogether"
    ),
    ForceFlag.LARGE_PRESS: (
        "pressed so far that the linear model is wrong: switch the large-press correction on, or "
        "press less"
    ),
    ForceFlag.NOT_CONVERGED: (
        "the large-press correction has not settled: it does within a second where the press "
        "stands still, unless that is beyond what the described gel can follow; then check "
        "thickness and modulus, or press less"
    ),
    ForceFlag.POOR_FIT: (
        "no force explains how the markers moved: zero again with nothing touching the gel, and "
        "check that the sensor description is this sensor's"
    ),
    ForceFlag.IMPLAUSIBLE: (
        "the markers show what no such gel can do or bear, so no force is given: check focus, "
        "exposure and what covers the pattern, zero again with nothing touching the gel, "
        "and check the sensor description's pitch, size and modulus"
    ),
    ForceFlag.ZERO_DOUBTFUL: (
        "zero again with nothing touching the gel: there is a force without any "
        "contact, or the reference was taken under load"
    ),
}

SLIP_WORDS: dict[SlipState, str] = {
    SlipState.UNKNOWN: "slip unknown",
    SlipState.NO_CONTACT: "no contact",
    SlipState.STICK: "sticks",
    SlipState.INCIPIENT: "begins to slip",
    SlipState.FULL: "slips",
}


def single_flags(flags: ForceFlag) -> Iterator[ForceFlag]:
    """The known flags that are set; bits that a newer sender knows are passed over."""
    return (flag for flag in ADVICE if flag & flags)


def flag_names(flags: ForceFlag, separator: str = ", ") -> str:
    """Names of the known flags that are set, such as 'at_border, no_depth'."""
    return separator.join(str(flag.name).lower() for flag in single_flags(flags))
