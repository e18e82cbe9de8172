"""Slip state and flags of a ForceField in words: what is the matter, and what helps."""

from __future__ import annotations

from collections.abc import Iterator

from cmp_tactile_processing.measured import ForceFlag, SlipState

# With these the force is wrong by an amount that its standard deviation may not include.
DOUBTS = ForceFlag.ZERO_DOUBTFUL | ForceFlag.DESCRIPTION_DOUBTFUL | ForceFlag.SCALE_UNCERTAIN
# With these the force is not that of the object (docs/results.md, "Flags").
UNUSABLE = (
    ForceFlag.FEW_MARKERS
    | ForceFlag.BEYOND_MARKERS
    | ForceFlag.POOR_FIT
    | ForceFlag.IMPLAUSIBLE
    | DOUBTS
)
_ZERO = "zero again while nothing touches the gel"
_REFERENCE = (
    "process it again with a reference of frames in which nothing touches the gel, as "
    "--reference first-N"
)
ADVICE: dict[ForceFlag, str] = {
    ForceFlag.FEW_MARKERS: (
        "too few markers are seen to determine a force: see the faults of the views"
    ),
    ForceFlag.AT_BORDER: (
        "a load reaches the edge of the marker area: the part beyond the edge is measured only "
        "partly; move the contact onto the markers before you measure"
    ),
    ForceFlag.BEYOND_MARKERS: (
        "a load acts outside the marker area: force and moment are wrong, for the whole load and "
        "for its part on the markers; move the contact onto the markers"
    ),
    ForceFlag.HIDDEN_CONTACT: (
        "markers under or beside a contact are not seen: the force there is inferred from the "
        "markers around it; remove what hides them"
    ),
    ForceFlag.NO_DEPTH: (
        "one view measures no depth: the normal force is inferred from how the markers spread; "
        "if the camera looks at the gel from the side, it can be completely wrong"
    ),
    ForceFlag.LARGE_PRESS: (
        "the press is too deep for the linear model: set elastomer.model to neo_hookean with "
        "force.large_press auto, or press less"
    ),
    ForceFlag.NOT_CONVERGED: (
        "the large-press correction has not settled: if the flag stays for more than a second "
        "while the press is still, check thickness and modulus, or press less"
    ),
    ForceFlag.POOR_FIT: (
        f"no force explains how the markers moved: {_ZERO}, and check that this is the "
        "description of the sensor"
    ),
    ForceFlag.IMPLAUSIBLE: (
        "the markers moved as no gel of this description can, so no force is given: check focus, "
        f"exposure and what covers the pattern; {_ZERO}; check pitch, size and modulus in the "
        "sensor description"
    ),
    ForceFlag.ZERO_DOUBTFUL: (
        f"there is a force without a contact, or the reference was taken under load: {_ZERO}"
    ),
    ForceFlag.DESCRIPTION_DOUBTFUL: (
        "the gel at rest is not where the sensor description has it, so forces are off by some "
        "percent: measure the print and the rig, or run `cmp_tactile calibrate gel`"
    ),
    ForceFlag.SCALE_UNCERTAIN: (
        "modulus, thickness, optics or unit of length of the description were assumed (see "
        "`cmp_tactile info`): ratios of forces hold, newtons do not; measure what was assumed, or "
        "run `cmp_tactile calibrate force`"
    ),
}
# The same for a recording, which cannot be zeroed.
RECORDED_ADVICE = {flag: text.replace(_ZERO, _REFERENCE) for flag, text in ADVICE.items()}

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
