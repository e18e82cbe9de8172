"""What speaks against a fitted relaxation, in words, and what to do."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.calibration.outcome import Finding, Severity

__all__ = ["Evidence", "SecondTerm", "relaxation_findings"]

# How much better a term must make the fit, in variances, to be believed: its time constant was
# looked for, so that noise alone gets to 15 in one record of 1,000.
SIGNIFICANT = 20.0
# Readings at the beginning above this share of the highest are a gel that was loaded before.
STARTS_LOADED, STARTS_TOUCHED = 0.1, 0.03
# Time constants for which a load should be held.
HELD_WANTED = 3.0
# Relative standard deviations above which a value is of no use.
USELESS_SHARE, USELESS_TIME = 0.3, 0.5
# Errors of the force, as shares of the highest, that a second term is worth a word for.
SECOND_MATTERS = 0.003
MOST_SHARE = 0.95
# Samples within a time constant that it takes to see it.
SAMPLES_WANTED = 3.0


@dataclass(frozen=True)
class SecondTerm:
    """The best fit with two time constants.

    shares, times (s): of the two.  significance: how much better it is, in variances.  differs: the
    largest difference of force from the fit with one, as a share of the highest force.
    """

    shares: tuple[float, float]
    times: tuple[float, float]
    significance: float
    differs: float


@dataclass(frozen=True)
class Evidence:
    """What a fit is judged by.

    least_share: that would have been seen, of a time constant that suits the record.
    significance: how much better it is than none, in variances.  at_start: reading at the
    beginning over the highest.  held_s: how long the gel was loaded.  sample_s: distance of
    samples.  at_longest: the time constant is the longest that was tried.
    """

    share: float
    share_std: float
    least_share: float
    time: float
    time_std: float
    significance: float
    at_start: float
    held_s: float
    sample_s: float
    at_longest: bool
    second: SecondTerm | None


def relaxation_findings(evidence: Evidence) -> tuple[tuple[Finding, ...], bool]:
    """What was found, and whether there is a relaxation to be told."""
    findings = _start_findings(evidence)
    if evidence.significance < SIGNIFICANT:
        text = (
            f"No relaxation is seen in {evidence.held_s:.3g} s of load: its share is below "
            f"{evidence.least_share:.2g}."
        )
        advice = (
            "If force drifts nevertheless, hold a larger load for longer and record it from before "
            "it comes."
        )
        findings.append(Finding(Severity.WARNING, text, advice))
        return tuple(findings), False
    if not 0 < evidence.share < MOST_SHARE:
        text = (
            f"The record asks for a share of {evidence.share:.2g}: the force read rises where the "
            "true one does, or falls, the other way than that of a gel that yields."
        )
        advice = (
            "Are reading and reference of the same sign and clock, and not exchanged? Does the "
            "reference drift?"
        )
        return (*findings, Finding(Severity.ERROR, text, advice)), False
    findings += _time_findings(evidence)
    findings += _second_findings(evidence)
    return tuple(findings), True


def _start_findings(evidence: Evidence) -> list[Finding]:
    if evidence.at_start < STARTS_TOUCHED:
        return []
    loaded = evidence.at_start > STARTS_LOADED
    text = f"The record begins with {evidence.at_start:.0%} of the highest reading on the gel"
    text += ": what came before is not known." if loaded else "."
    advice = "Begin while nothing touches the gel and it has recovered from the last contact."
    return [Finding(Severity.ERROR if loaded else Severity.WARNING, text, advice)]


def _time_findings(evidence: Evidence) -> list[Finding]:
    useless = (
        evidence.share_std > USELESS_SHARE * evidence.share
        or evidence.time_std > USELESS_TIME * evidence.time
        or evidence.at_longest
    )
    if useless:
        text = (
            f"Loaded for {evidence.held_s:.3g} s the gel does not tell how far it yields: a share "
            f"of {evidence.share:.2g} (std {evidence.share_std:.1g}) with {evidence.time:.3g} s "
            f"(std {evidence.time_std:.1g} s)."
        )
        return [Finding(Severity.ERROR, text, _LONGER)]
    findings = []
    if evidence.held_s < HELD_WANTED * evidence.time:
        text = (
            f"The load was held for {evidence.held_s:.3g} s, {evidence.held_s / evidence.time:.2g} "
            "time constants: what fades later is not seen."
        )
        findings.append(Finding(Severity.WARNING, text, _LONGER))
    if evidence.time < SAMPLES_WANTED * evidence.sample_s:
        text = (
            f"Samples come every {evidence.sample_s:.2g} s, too seldom for a time constant of "
            f"{evidence.time:.2g} s."
        )
        advice = "Record at a higher rate."
        findings.append(Finding(Severity.WARNING, text, advice))
    return findings


_LONGER = f"Hold the load for {HELD_WANTED:g} time constants or more."


def _second_findings(evidence: Evidence) -> list[Finding]:
    second = evidence.second
    if second is None or second.significance < SIGNIFICANT or second.differs < SECOND_MATTERS:
        return []
    both = " and ".join(
        f"{share:.2g} with {time:.2g} s"
        for share, time in zip(second.shares, second.times, strict=True)
    )
    text = (
        f"The gel has more than one time constant, about {both}; the one that is fitted misses the "
        f"force of this record by up to {second.differs:.1%} of the highest."
    )
    advice = "Fit a record that is as long as the contacts that matter."
    return [Finding(Severity.WARNING, text, advice)]
