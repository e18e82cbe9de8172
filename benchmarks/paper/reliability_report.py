"""What section IV.F comes to: where each method begins to fail."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from paper.disturbances import SWEEPS, Sweep
from paper.dot_methods import ALL_METHODS
from paper.experiment import (
    Claim,
    Deviation,
    Experiment,
    Figure,
    Report,
    Results,
    Table,
    Text,
)
from paper.failure_levels import Endurance
from paper.method import CMP
from paper.reliability import PRESS_FRAMES, REST_FRAMES, cases
from paper.reliability_figures import draw_curves, draw_strips, level_text

__all__ = ["EXPERIMENT", "claims", "comparison", "endurances_of", "limits", "report"]

Endurances = Mapping[tuple[str, str], Endurance]
OF_THE_PAPER = ("light", "contrast", "salt_and_pepper")
FURTHER = ("gaussian", "blur")
DOTS = tuple(method for method in ALL_METHODS if method.pattern_type == "dmp")

SETUP = Text(
    "A ring (the one of section IV.C, pressed off the middle and then sheared: a contact that "
    "nothing was tuned on) is shown to every method on the print that it needs, with the same "
    f"deformation and the same noise: {REST_FRAMES} frames at rest, from which reference and first "
    f"places are taken, then {len(PRESS_FRAMES)} frames from rest to full press and shear. All of "
    "them are spoilt alike, the reference too. The frames come in order and nothing moves by more "
    "than a third of a checker between two of them, so that frame-to-frame methods are not tried "
    "by speed here. A level fails where in any frame of any repetition a visible marker of either "
    "view is lost or bears a wrong number (lies nearer to another one, or half a checker off), or "
    "where the chain takes no reference, because fewer than half of the markers are found at rest "
    "or they scatter as if the gel moved; there is no error of displacement then."
)
DEFINITIONS = Text(
    "Our reading of the paper's measures. Light: its ratio of the dominant peak of the histogram "
    "to the minimum peak is taken for that of the least to the best lit light skin within the "
    "pattern, both views together; illumination falls linearly, along the frame's y, x or diagonal "
    "(one for each repetition). The histograms of the pictures themselves say the same: see the "
    "table. If greys of the two colours' peaks are meant, the sweep of the contrast tells: there "
    "the dark ink is made lighter, by visibility, (light - dark) / (light + dark). Noise: the "
    "usual snippet for salt and pepper calls the share of pixels that are left alone its SNR; "
    "0.95 is then 5 % of the pixels spoilt, half of them white, half black. A power ratio stands "
    "beside it; read as one, 0.95 would be noise as strong as the picture, and could not make the "
    "paper call its method sensitive to noise. Gaussian noise and blur are not in the paper."
)
SHARED = Text(
    "`CMP, the paper's algorithm` is the paper's sequence of steps as written here: its filter "
    "against impulses and its sub-pixel corners are those of our own chain, since the paper names "
    "the steps but not their details. Where it bears more than the paper reports, that tells of "
    "these, not of the authors' code. The dots have the same filter. The three DMP methods detect "
    "dots in the same way and differ in how they number them; where curves coincide, detection is "
    "what fails."
)


def report(results: Results, folder: Path) -> Report:
    """Figures, tables and claims."""
    endurances = endurances_of(results)
    cmp = {key: endurances[key, CMP.key] for key in SWEEPS}
    curves = draw_curves(endurances, OF_THE_PAPER, folder / "reliability_limits.png")
    further = draw_curves(endurances, FURTHER, folder / "reliability_further.png")
    strips = draw_strips(
        results, cmp, ("light", "salt_and_pepper"), folder / "reliability_frames.png"
    )
    blocks = (
        SETUP,
        DEFINITIONS,
        limits(endurances),
        comparison(endurances),
        Figure(curves, "What each method bears; to the right it gets worse. Dashed: the paper."),
        Figure(strips, "The middle of the left view at full press and shear, in either print."),
        Figure(further, "Beyond the paper: Gaussian noise and blur."),
        _readings(results),
        SHARED,
    )
    return Report(blocks, claims(endurances), DEVIATIONS)


def endurances_of(results: Results) -> Endurances:
    """By disturbance and method."""
    return {
        (key, method.key): Endurance.from_arrays(
            results[f"{key}-{method.pattern_type}"], method.key
        )
        for key in SWEEPS
        for method in ALL_METHODS
    }


def limits(endurances: Endurances) -> Table:
    """Where each method begins to fail, and where half of its markers are lost."""
    head = ("method", *(f"{sweep.title}: {sweep.level}" for sweep in SWEEPS.values()))
    rows = tuple(
        (
            method.label,
            *(_limit_text(SWEEPS[key], endurances[key, method.key]) for key in SWEEPS),
        )
        for method in ALL_METHODS
    )
    caption = (
        "The first level that fails (in brackets: the one from which on half of the markers are "
        "lost)."
    )
    return Table(head, rows, caption)


def _limit_text(sweep: Sweep, endurance: Endurance) -> str:
    first, half = endurance.fails_at, endurance.half_lost_at
    if first is None:
        return f"none to {level_text(sweep, float(endurance.levels[-1]))}"
    lost = "never" if half is None else level_text(sweep, float(endurance.levels[half]))
    return f"{level_text(sweep, float(endurance.levels[first]))} ({lost})"


def comparison(endurances: Endurances) -> Text:
    """Where dots do better, as well or worse, in words made from the counts."""
    names: dict[int, list[str]] = {1: [], 0: [], -1: []}
    for key, sweep in SWEEPS.items():
        best = max(
            (endurances[key, method.key] for method in DOTS),
            key=lambda e: len(e.levels) if e.fails_at is None else e.fails_at,
        )
        names[endurances[key, CMP.key].outlasts(best)].append(sweep.title.lower())
    parts = [
        f"{said} under {_listed(names[sign])}"
        for sign, said in (
            (1, "CMP holds out longer than the best DMP method"),
            (0, "they begin to fail at the same level, or not at all,"),
            (-1, "DMP holds out longer"),
        )
        if names[sign]
    ]
    wrong = {
        method.label: sum(int(endurances[key, method.key].wrong.sum()) for key in SWEEPS)
        for method in ALL_METHODS
    }
    counts = ", ".join(f"{label} {count}" for label, count in wrong.items())
    text = "; ".join(parts)
    return Text(
        f"{text[0].upper()}{text[1:]}. {_at_the_end(endurances)} "
        f"Wrong numbers in all frames together: {counts}."
    )


def _at_the_end(endurances: Endurances) -> str:
    """What is left of the markers at the worst levels."""
    parts = []
    for key, sweep in SWEEPS.items():
        cmp = float(endurances[key, CMP.key].found[-1])
        dots = max(float(endurances[key, method.key].found[-1]) for method in DOTS)
        level = level_text(sweep, _worst(endurances, key))
        parts.append(f"{sweep.title.lower()} {level}: {100 * cmp:.3g} and {100 * dots:.3g} %")
    return f"Of the markers CMP and the best DMP method find at the last level: {'; '.join(parts)}."


def _worst(endurances: Endurances, key: str) -> float:
    """The worst level of a disturbance."""
    return float(endurances[key, CMP.key].levels[-1])


def _listed(names: list[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _readings(results: Results) -> Table:
    light, noise = results["light-cmp"], results["salt_and_pepper-cmp"]
    contrast = results["contrast-cmp"]
    rows = [
        ("light " + level_text(SWEEPS["light"], float(level)), f"light peaks {ratio:.2f}")
        for level, ratio in zip(light["levels"], light["light_peaks"], strict=True)
    ]
    rows += [
        (
            "visibility " + level_text(SWEEPS["contrast"], float(level)),
            f"peaks at greys {dark} and {bright}, ratio {dark / max(bright, 1):.2f}",
        )
        for level, (dark, bright) in zip(contrast["levels"], contrast["peaks"], strict=True)
    ]
    rows += [
        (
            level_text(SWEEPS["salt_and_pepper"], float(level)) + " of the pixels spoilt",
            f"{1 - level:.2f} untouched, power SNR {snr:.1f} dB",
        )
        for level, snr in zip(noise["levels"], noise["snr_db"], strict=True)
    ]
    caption = (
        "What CMP's pictures themselves tell of the levels. Light peaks: that of the histogram's "
        "brighter half in the darkest over that in the brightest of 16 tiles of each view. "
        "Power SNR: mean square of the clean picture over that of the noise; at 0 % spoilt there "
        "is a read noise of 1 grey level."
    )
    return Table(("set", "measured in the picture"), tuple(rows), caption)


def claims(endurances: Endurances) -> tuple[Claim, ...]:
    """The paper's limits beside ours."""
    light, contrast, noise = (endurances[key, CMP.key] for key in OF_THE_PAPER)
    least_light = light.bears
    most_noise = noise.bears
    return (
        Claim(
            "IV.F",
            "CMP works in uneven light",
            "works for ratios > 0.4",
            _range_text("light", light),
            least_light is not None and least_light <= _limit("light"),
        ),
        Claim(
            "IV.F",
            "CMP works at low visibility",
            "did not fail at the visibility that the simulation provided (not told)",
            _range_text("contrast", contrast),
            None,
        ),
        Claim(
            "IV.F",
            "CMP under salt and pepper",
            "begins to fail at SNR < 0.95 (read as more than 5 % of the pixels spoilt)",
            _range_text("salt_and_pepper", noise),
            most_noise is not None and most_noise >= _limit("salt_and_pepper"),
        ),
    )


def _limit(key: str) -> float:
    limit = SWEEPS[key].paper_limit
    return float("nan") if limit is None else limit


def _range_text(key: str, endurance: Endurance) -> str:
    sweep, first = SWEEPS[key], endurance.fails_at
    if endurance.bears is None:
        return "fails without it"
    bears = level_text(sweep, endurance.bears)
    if first is None:
        return f"works to {bears}, the last level tried"
    found = np.round(100 * endurance.found[first], 1)
    at = level_text(sweep, float(endurance.levels[first]))
    return f"works to {bears}; begins to fail at {at} ({found:.3g} % of the markers found there)"


def _repetitions() -> str:
    counts = {sweep.repetitions for sweep in SWEEPS.values()}
    return " or ".join(str(count) for count in sorted(counts))


DEVIATIONS = (
    Deviation(
        "disturbances",
        "light and salt and pepper in a renderer, levels and measures not defined",
        "simulated camera: light that falls linearly across the pattern, impulses on the digital "
        "picture; vignetting of 15 % and a read noise of 1 grey level besides",
        "defined so that anybody can repeat it",
    ),
    Deviation(
        "methods",
        "CMP alone",
        "DMP with the same disturbances as well",
        "robustness means little without something to compare it with",
    ),
    Deviation(
        "what fails",
        "not defined",
        "the first lost marker or wrong number in any frame of any repetition",
        "the strictest reading",
    ),
    Deviation(
        "repetitions",
        "not told",
        f"{_repetitions()} of each level (fast run: one), each with noise of its own and, of the "
        "light, another direction",
        "levels lie far apart beside what noise moves; a limit between two of them is not told",
    ),
)

EXPERIMENT = Experiment(
    key="reliability",
    section="IV.F",
    title="Reliability in uneven light and noise",
    cases=cases,
    report=report,
)
