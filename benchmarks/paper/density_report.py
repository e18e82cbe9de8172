"""Table I: densities counted and measured, peers, claims."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from paper.density import METHODS, STATES, cases
from paper.experiment import (
    Arrays,
    Claim,
    Deviation,
    Experiment,
    Figure,
    Report,
    Results,
    Table,
    Text,
    number,
)
from paper.figure_style import COLOURS, PAPER_COLOUR, apply, save
from paper.method import CMP, Method

__all__ = ["EXPERIMENT", "densities", "report"]

# Per cm^2, of the paper's Table I: measured markers and virtual ones.
PAPER = (189.0, 2078.0)
PEERS = {"GelForce, 2 layers of 120": 240.0, "GelSight": 83.0, "Tactip": 178.0}
STATE_WORDS = {"rest": "at rest", "press": "under the press"}
M2_PER_CM2 = 1e-4
PARTS = ("corners", "virtual")


def report(results: Results, folder: Path) -> Report:
    """How dense the information is."""
    told = results["prototype"]
    corners, virtual = densities(told)
    depth, force = number(told, "depth") * 1e3, number(told, "normal_force")
    area = number(told, "area") / M2_PER_CM2
    blocks = (
        Text(
            f"The prototype's print has {number(told, 'corners'):.0f} corners and "
            f"{number(told, 'virtual'):.0f} virtual markers, as many on each stretch of gridline "
            "between two corners. Its area is that of the checkers around the corners, laid flat: "
            f"{area:.3f} cm2, one checker beyond each outer corner. That makes {corners:.0f} + "
            f"{virtual:,.0f} per cm2. The paper's 189 for 400 corners is an area of 2.116 cm2, its "
            "2,078 about 110 virtual markers on each of the 40 gridlines, where ours have 114. The "
            "pitch is not told in the paper; that of our prototype was chosen for about this "
            "density, so the count is no proof of anything."
        ),
        _densities(told),
        Text(
            "Counting is cheap: virtual markers can be set as densely as one likes. So here is how "
            "many of them were really measured in rendered frames with noise, each at its own "
            "place across the gridline, rather than filled in from neighbours; at rest, and under "
            f"a ball of 20 mm pressed {depth:.2f} mm deep ({force:.2g} N). A corner tells two "
            "coordinates of the image, a virtual marker one: where its gridline runs, and not what "
            "lies where along it. The paper's algorithm is our reading of section III.C: where its "
            "window holds no edge that it can fit, the marker is filled in."
        ),
        _measured(told),
        Text(_in_space(told)),
        Figure(
            _picture(told, folder / "density.png"),
            "Markers per cm2. Ours measured: corners and virtual markers that both counts and "
            "status `MEASURED` hold for, in the image of one view under the press, and in space. "
            "The figures of the other sensors are those of the paper's Table I.",
        ),
    )
    return Report(blocks, _claims(told), _deviations())


def densities(told: Arrays) -> tuple[float, float]:
    """Corners and virtual markers per cm^2."""
    area = number(told, "area") / M2_PER_CM2
    return number(told, "corners") / area, number(told, "virtual") / area


def _densities(told: Arrays) -> Table:
    corners, virtual = densities(told)
    gel = number(told, "area") / M2_PER_CM2 / 4.84
    rows = (
        ("CMP here, on the area of the print", f"{corners:.0f}", f"{virtual:,.0f}"),
        (
            "CMP here, on the whole gel, 22 mm x 22 mm",
            f"{corners * gel:.0f}",
            f"{virtual * gel:,.0f}",
        ),
        ("CMP in the paper (Tac3D)", f"{PAPER[0]:.0f}", f"{PAPER[1]:,.0f}"),
        ("DMP here, a dot in the place of each corner", f"{corners:.0f}", "0"),
        *((name, f"{value:.0f}", "0") for name, value in PEERS.items()),
    )
    return Table(("Per cm2", "measured markers", "virtual markers"), rows)


def _measured(told: Arrays) -> Table:
    rows = tuple(_measured_row(told, method, state) for method in METHODS for state in STATES)
    draws = len(told["cmp_rest_space"])
    head = (
        "Method",
        "gel",
        "corners measured",
        "virtual measured in a view",
        "virtual per cm2",
        "RMS across the gridline",
        "RMS of corners",
        "virtual measured in 3-D",
    )
    caption = f"Of both views, {draws} draws of noise; the shares are means over draws."
    return Table(head, rows, caption)


def _measured_row(told: Arrays, method: Method, state: str) -> tuple[str, ...]:
    key = f"{method.key}_{state}"
    share = _share(told, f"{key}_virtual")
    return (
        method.label,
        STATE_WORDS[state],
        _percent(_share(told, f"{key}_corners")),
        _percent(share),
        f"{share * densities(told)[1]:,.0f}",
        _length(told, f"{key}_error"),
        _length(told, f"{key}_corner_error"),
        _percent(_share(told, f"{key}_space")),
    )


def _share(told: Arrays, name: str) -> float:
    return float(np.mean(told[name]))


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _length(told: Arrays, name: str) -> str:
    """RMS in px, and on the gel at the mean scale of the views."""
    rms = float(np.sqrt(np.mean(np.square(told[name]))))
    area, corners = number(told, "area"), number(told, "corners")
    pitch = np.sqrt(area) / (np.sqrt(corners) + 1)
    return f"{rms:.4f} px, {1e6 * rms * pitch / number(told, 'pitch_px'):.2g} um"


def _in_space(told: Arrays) -> str:
    share = _share(told, f"{CMP.key}_press_space")
    density = share * densities(told)[1]
    return (
        f"In space {share:.0%} of CMP's virtual markers are measured, {density:,.0f} per cm2: "
        "those on gridlines across the direction from one view to the other. On the gridlines "
        "along it both views tell the same coordinate, and the other, nearly the depth, is taken "
        f"from a curve through the corners (`PREDICTED`). So the density of depth is {share:.0%} "
        "of what the count promises; of the paper's sensor, whose views lie side by side as well, "
        "the same is to be expected."
    )


def _picture(told: Arrays, path: Path) -> Path:
    apply()
    from matplotlib import pyplot as plt

    corners, virtual = densities(told)
    bars: dict[str, tuple[float, float, str]] = {
        "CMP, paper": (*PAPER, PAPER_COLOUR),
        "CMP here, counted": (corners, virtual, COLOURS[CMP.key]),
    }
    for method in METHODS:
        seen, filled = (_share(told, f"{method.key}_press_{what}") for what in PARTS)
        label = f"{method.label}, measured"
        bars[label] = (corners * seen, virtual * filled, COLOURS[method.key])
        if method is CMP:
            seen, filled = (_share(told, f"cmp_press_{what}") for what in ("corners", "space"))
            bars["CMP, measured in 3-D"] = (corners * seen, virtual * filled, COLOURS[method.key])
    bars["DMP here"] = (corners, 0.0, COLOURS["dmp_grid"])
    bars |= {name: (value, 0.0, PAPER_COLOUR) for name, value in PEERS.items()}
    figure, axes = plt.subplots(figsize=(9.0, 3.4))
    for place, (one, other, colour) in enumerate(reversed(bars.values())):
        axes.barh(place, one, color=colour)
        axes.barh(place, other, left=one, color=colour, alpha=0.45)
        text = f"{one:.0f} + {other:,.0f}" if other else f"{one:.0f}"
        axes.text(one + other + 25, place, text, va="center")
    axes.set_yticks(range(len(bars)), list(reversed(bars)))
    axes.set_xlabel("markers per cm²: corners or dots (solid), virtual markers (light)")
    axes.set_xlim(0, 1.18 * max(one + other for one, other, _ in bars.values()))
    axes.grid(visible=False, axis="y")
    return save(figure, path)


def _claims(told: Arrays) -> tuple[Claim, ...]:
    corners, virtual = densities(told)
    share = _share(told, f"{CMP.key}_press_virtual")
    most = max(PEERS.values())
    return (
        Claim(
            "Table I",
            "information density of CMP, markers + virtual markers per cm2 of the print",
            f"{PAPER[0]:.0f} + {PAPER[1]:,.0f}",
            f"{corners:.0f} + {virtual:,.0f}, {virtual * share:,.0f} measured under a press",
            met=bool(corners >= PAPER[0] and share * virtual >= PAPER[1]),
        ),
        Claim(
            "Table I",
            "denser than GelForce, GelSight and Tactip",
            "189 + 2,078 against 120 x 2, 83 and 178",
            f"with virtual markers {corners + share * virtual:,.0f}; corners alone, {corners:.0f}, "
            f"are {'more' if corners > most else 'fewer'} than GelForce's two layers",
            met=bool(corners + share * virtual > most),
        ),
    )


def _deviations() -> tuple[Deviation, ...]:
    return (
        Deviation(
            "pitch of the prototype",
            "not told; 189 per cm2 of 400 corners make a square of 14.55 mm, "
            "if that is the area that is meant",
            "0.690 mm, 21 checkers over 14.5 mm",
            "assumed, so that the density is about that of the paper",
        ),
        Deviation(
            "virtual markers",
            "2,078 per cm2, about 110 on a gridline; how many on a stretch is not told",
            "6 on each stretch between two corners, 114 on a gridline",
            "the same number everywhere; docs/tracking.md",
        ),
    )


EXPERIMENT = Experiment(
    key="density",
    section="Table I",
    title="Information density",
    cases=cases,
    report=report,
)
