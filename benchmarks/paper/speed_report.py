"""V.A: frames a second, claims."""

from __future__ import annotations

from pathlib import Path

from cmp_tactile_bringup.terminal.machine import processor_name
from paper.dot_methods import ALL_METHODS
from paper.experiment import Arrays, Claim, Deviation, Experiment, Report, Results, Table, Text
from paper.speed import PLAIN, cases, median_ms

__all__ = ["EXPERIMENT", "report"]

# The paper's, Hz; what it includes is not told.
PAPER_CMP, PAPER_DMP = 18.0, 24.0
PLAIN_LABEL = "dots, at the least"


def report(results: Results, _folder: Path) -> Report:
    """How fast the methods are."""
    told = results["prototype"]
    blocks = (
        Text(
            "Frames of the prototype under a ball that is pressed in, 1024 x 768 px, given to all "
            "methods in turn in one process on one core. Times are the processor's, of each frame "
            f"the best of several passes, and of these the median over {len(told['cmp_chain'])} "
            "frames. Extraction is from the frame to the numbered markers of both views; the whole "
            "chain goes on to markers in 3-D and force. Code is Python, with NumPy, OpenCV and "
            "loops compiled by Numba."
        ),
        _table(told),
        Text(_verdict(told)),
    )
    return Report(blocks, _claims(told), _deviations())


def _table(told: Arrays) -> Table:
    rows = []
    for method in ALL_METHODS:
        times = (told[f"{method.key}_{what}"] for what in ("extraction", "chain"))
        texts = (text for each in times for text in _rate(median_ms(each)))
        rows.append((method.label, *texts))
    plain = (
        PLAIN_LABEL,
        *_rate(median_ms(told[f"{PLAIN}_extraction"])),
        *_rate(_plain_chain(told)),
    )
    head = ("Method", "extraction", "frames/s", "whole chain", "frames/s")
    caption = (
        f"The paper: CMP {PAPER_CMP:.0f} Hz, DMP {PAPER_DMP:.0f} Hz. The chain of the plain dots "
        "is their extraction and what CMP's chain takes after its own."
    )
    return Table(head, (*rows, plain), caption)


def _rate(ms: float) -> tuple[str, str]:
    return f"{ms:.1f} ms", f"{1e3 / ms:.0f}"


def _plain_chain(told: Arrays) -> float:
    rest = median_ms(told["cmp_chain"] - told["cmp_extraction"])
    return median_ms(told[f"{PLAIN}_extraction"]) + rest


def _verdict(told: Arrays) -> str:
    ours, nearest = (median_ms(told[f"{key}_extraction"]) for key in ("cmp", "dmp_nearest"))
    plain = median_ms(told[f"{PLAIN}_extraction"])
    return (
        "The rates of the dot methods are those of programs that were written for precision, and "
        f"never for speed: that CMP's extraction ({ours:.1f} ms) takes another time than that of "
        f"DMP with the nearest dot ({nearest:.1f} ms) says little of the patterns. So the last row "
        "is the least that section II.A asks for: an adaptive threshold, centres of connected "
        "parts and the nearest dot of the frame before, without care for light, blur or numbers. "
        f"It takes {plain:.1f} ms, {_times(ours, plain)} CMP's: dots can be found faster than "
        "gridlines, as the paper says, by those who can do with less precision."
        if plain < ours
        else f"Even the least that section II.A asks for takes {plain:.1f} ms, CMP {ours:.1f} ms."
    )


def _times(ours: float, plain: float) -> str:
    return f"{plain / ours:.2f} of"


def _claims(told: Arrays) -> tuple[Claim, ...]:
    ours, plain = median_ms(told["cmp_chain"]), _plain_chain(told)
    nearest = median_ms(told["dmp_nearest_chain"])
    return (
        Claim(
            "V.A",
            "frames per second of CMP, with force, one core",
            f"{PAPER_CMP:.0f} Hz, C++ on an i7-9750H",
            f"{1e3 / ours:.0f} Hz, Python on {processor_name()}",
            met=1e3 / ours >= PAPER_CMP,
        ),
        Claim(
            "V.A",
            "rate of CMP over that of DMP",
            f"{PAPER_CMP / PAPER_DMP:.2f}",
            f"{plain / ours:.2f} with force against plain dots; {nearest / ours:.2f} against our "
            "DMP with the nearest dot, made for precision",
            met=plain / ours >= PAPER_CMP / PAPER_DMP,
        ),
    )


def _deviations() -> tuple[Deviation, ...]:
    return (
        Deviation(
            "what is timed",
            "processing frequency; what it includes and how many threads it has is not told",
            "extraction alone and the whole chain with force, on one core",
            "so that the ratio holds on other machines; with two threads both views run at once",
        ),
        Deviation(
            "code and machine",
            "C++ on an i7-9750H at 2.59 GHz",
            f"Python, NumPy, OpenCV and Numba on {processor_name()}",
            "what is here; both rates and ratios are those of programs, not of patterns",
        ),
    )


EXPERIMENT = Experiment(
    key="speed",
    section="V.A",
    title="Speed",
    cases=cases,
    report=report,
)
