"""Which pattern to print for a camera: the sweep's figure, a table and one sentence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cmp_tactile_processing.printing.advice import (
    LEAST_PITCH_OVER_SKIN,
    LEAST_SIDE_PX,
    POINTS_PER_SEGMENT,
    RECOMMENDED_SIDE_PX,
    PatternAdvice,
    advise,
)
from cmp_tactile_processing.sensor.library import load_sensor
from paper.experiment import (
    Block,
    Claim,
    Deviation,
    Experiment,
    Figure,
    Report,
    Results,
    Table,
    Text,
)
from paper.pattern_choice import CHECK_RIG, RIG, STANDARD_POINTS, cases
from paper.pattern_choice_figures import LIGHT_NAMES, draw_answer, draw_lights
from paper.pattern_choice_results import (
    Cell,
    best_pattern,
    by_width,
    cells_of,
    coarsest_that_works,
    errors_at,
    excess,
    nearest_to,
    works_down_to,
)
from paper.pattern_choice_rig import of_width
from paper.pattern_choice_score import finest_wave

__all__ = ["EXPERIMENT", "report"]

MICRO, MILLI = 1e6, 1e3
PAPER_WIDTH, PAPER_CORNERS = 1024, 20
MISSING = "-"


def report(results: Results, folder: Path) -> Report:
    """The answer first, then what it rests on."""
    cells = cells_of(results, RIG)
    checked = cells_of(results, CHECK_RIG)
    blocks: tuple[Block, ...] = (
        Text(_answer(cells)),
        Figure(
            draw_answer(cells, folder / "pattern_choice.png"),
            "Error of the dense displacement field between the markers against the true one, over "
            "the smallest checker of both views. Left: fine contacts; middle: smooth ones; "
            f"{STANDARD_POINTS} virtual markers in a segment. Shaded: the size recommended; dashed "
            "line: smaller ones fail first. Right: virtual markers, fine contacts.",
        ),
        _advised_table(cells),
        _sweep_table(cells),
        Figure(
            draw_lights(cells, folder / "pattern_choice_lights.png"),
            "The same in worse light. Left: error of the field among beads. Right: markers that "
            "are visible and have no place, all patterns and resolutions, each deformation coming "
            "as a knock.",
        ),
        _light_table(cells),
        Text(_points_text(cells)),
        *([_check_table(checked)] if checked else []),
    )
    return Report(blocks, (_claim(cells, checked),), _deviations())


def _advised(rig: str, width: int) -> PatternAdvice:
    return advise(of_width(load_sensor(rig), width))


def _excess(group: Sequence[Cell], light: str = "good") -> float:
    """Errors with the advised pattern over those of the best; of one rig and width."""
    return excess(group, _advised(group[0].rig, group[0].width).least_side_px, light)


def _answer(cells: Sequence[Cell]) -> str:
    groups = by_width(cells).values()
    best = [best_pattern(group) for group in groups]
    worst = [_excess(group, light) for group in groups for light in LIGHT_NAMES]
    skin = load_sensor(RIG).elastomer.shading_layer.thickness
    pitch = LEAST_PITCH_OVER_SKIN * skin
    return (
        f"Print checkers whose smallest side in the image is about {RECOMMENDED_SIDE_PX:g} px, "
        f"never below {LEAST_SIDE_PX:g} px, and of a pitch no finer than {pitch * MILLI:.2f} mm "
        f"({LEAST_PITCH_OVER_SKIN:g} times the skin's {skin * MILLI:g} mm), with "
        f"{POINTS_PER_SEGMENT} virtual markers in a segment: what `pattern_advice` says, whose "
        "figures were read from this sweep. In good light the errors of the field between markers, "
        "fine and smooth contacts counted alike, are least at "
        f"{_range([cell.side_least for cell in best])} px, depending on the resolution; with the "
        f"advised patterns they are at most {max(worst) - 1:.0%} larger, at any resolution and in "
        "any of four lights. Larger checkers leave out what lies between their lines; smaller "
        "ones are placed worse, one by one. That the pitch's limit goes with the skin is "
        "assumed: one skin was measured. `cmp_tactile pattern` writes the pattern that this gives."
    )


def _advised_table(cells: Sequence[Cell]) -> Table:
    rows = []
    for width, group in by_width(cells).items():
        advice = _advised(RIG, width)
        fine, smooth = errors_at(group, advice.least_side_px)
        paper = next((cell for cell in group if cell.corners == PAPER_CORNERS), None)
        rows.append(
            (
                f"{width} x {width * 3 // 4}",
                f"{advice.rows} x {advice.cols}",
                f"{advice.pitch * MILLI:.3f}",
                f"{advice.least_side_px:.1f}",
                str(advice.points_per_segment),
                f"{_um(fine)} / {_um(smooth)}",
                _wave(nearest_to(group, advice.least_side_px)),
                MISSING if paper is None else f"{_um(paper.fine())} / {_um(paper.smooth())}",
            )
        )
    return Table(
        (
            "image, px",
            "print (corners)",
            "pitch, mm",
            "smallest checker, px",
            "virtual per segment",
            "fine / smooth, µm",
            "finest wave, mm",
            "20 x 20: fine / smooth, µm",
        ),
        tuple(rows),
        "The recommended pattern for the prototype's optics and gel, by the camera's resolution: "
        "what `pattern_advice.advise` says, and RMS errors of the field in good light, between "
        f"those of the next patterns of the sweep (with {STANDARD_POINTS} virtual markers; finest "
        "wave: of the nearest); last the paper's number of corners.",
    )


def _sweep_table(cells: Sequence[Cell]) -> Table:
    standard = by_width(cells).get(PAPER_WIDTH, [])
    rows = tuple(
        (
            f"{cell.corners} x {cell.corners}",
            f"{cell.side_least:.1f}",
            f"{100 * cell.lost_share('good'):.2g}",
            f"{int(cell.wrong.sum())}",
            _um(float(cell.marker[0])),
            _um(cell.fine()),
            _um(cell.smooth()),
            _wave(cell),
            f"{cell.seconds[STANDARD_POINTS] * MILLI:.0f}",
        )
        for cell in standard
    )
    return Table(
        (
            "corners",
            "smallest checker, px",
            "lost, %",
            "wrong, all lights",
            "marker, µm",
            "fine, µm",
            "smooth, µm",
            "finest wave, mm",
            "time, ms",
        ),
        rows,
        f"All patterns before a camera of {PAPER_WIDTH} x {PAPER_WIDTH * 3 // 4} px, good light, "
        f"{STANDARD_POINTS} virtual markers in a segment. marker: RMS length of the error of a "
        "marker's displacement; finest wave: wavelength at which half of the amplitude of a plane "
        "wave in depth is left; time: processor time on one thread of a followed frame, both "
        "views, with triangulation and dense surface.",
    )


def _light_table(cells: Sequence[Cell]) -> Table:
    rows = []
    for light, name in LIGHT_NAMES.items():
        groups = by_width(cells).values()
        reached = [works_down_to(group, light, RECOMMENDED_SIDE_PX) for group in groups]
        best = [best_pattern(group, light).side_least for group in groups]
        over = [_excess(group, light) for group in groups]
        known = [side for side in reached if np.isfinite(side)]
        rows.append(
            (
                name,
                _reached(known, len(reached)),
                _range(best),
                f"{max(over) - 1:.0%}",
                str(int(sum(cell.wrong[list(LIGHT_NAMES).index(light)] for cell in cells))),
            )
        )
    return Table(
        (
            "light",
            "all found down to, px",
            "least error at, px",
            "as advised: worse by at most",
            "wrong numbers",
        ),
        tuple(rows),
        "By light. All found down to: the size of checkers down to which no visible marker of any "
        "deformation is lost and none bears another's number, or those of the finest pattern "
        "swept; the largest of all resolutions, or of those at which there is such a size.",
    )


def _reached(sides: Sequence[float], resolutions: int) -> str:
    """The largest of the sides; of how many resolutions, where not of all."""
    if not sides:
        return MISSING
    some = "" if len(sides) == resolutions else f" ({len(sides)} of {resolutions} resolutions)"
    return f"{max(sides):.1f}{some}"


def _check_table(cells: Sequence[Cell]) -> Table:
    rows = []
    for width, group in by_width(cells).items():
        best = best_pattern(group)
        advice = _advised(CHECK_RIG, width)
        fine, smooth = errors_at(group, advice.least_side_px)
        rows.append(
            (
                f"{width} x {width * 3 // 4}",
                f"{best.corners} x {best.corners}, {best.side_least:.1f} px",
                f"{_um(best.fine())} / {_um(best.smooth())}",
                f"{advice.rows} x {advice.cols}, {advice.least_side_px:.1f} px",
                f"{_um(fine)} / {_um(smooth)}",
                f"{max(_excess(group) - 1, 0.0):.0%}",
            )
        )
    return Table(
        (
            "image, px",
            "least error with",
            "fine / smooth, µm",
            "advised",
            "fine / smooth, µm",
            "worse by",
        ),
        tuple(rows),
        "The same on other optics (`sample_rig`: another focal length and other mirrors), from "
        "which the recommendation was not read.",
    )


def _points_text(cells: Sequence[Cell]) -> str:
    group = by_width(cells)[PAPER_WIDTH]
    coarse, advised = nearest_to(group, 14.0), nearest_to(group, RECOMMENDED_SIDE_PX)
    told = [
        f"{cell.side_least:.0f} px wide: {_um(cell.fine(points=0))} without, "
        f"{_um(cell.fine())} with"
        for cell in (coarse, advised)
    ]
    small = [cell for cell in cells if cell.fine(points=0) < cell.fine()]
    harm = ""
    if small:
        harm = (
            f" They do harm on checkers of up to {max(cell.side_least for cell in small):.1f} px "
            f"({len(small)} of {len(cells)} patterns): leave them out there."
        )
    limit = coarsest_that_works(group, RECOMMENDED_SIDE_PX)
    coarse_end = ""
    if limit is not None and limit is not group[0]:
        coarse_end = (
            f" Coarse patterns have a limit, too: with fewer than {limit.corners} x "
            f"{limit.corners} corners the knock bends gridlines by so much within one checker "
            "that markers are lost."
        )
    return (
        f"Virtual markers, {STANDARD_POINTS} in a segment, by the beads' error (µm RMS; checkers "
        f"{told[0]}; {told[1]}).{_few_points(cells)}{harm}{coarse_end}"
    )


def _few_points(cells: Sequence[Cell]) -> str:
    """What fewer virtual markers give of what the standard number does, where it helps."""
    counts = sorted({count for cell in cells for count in cell.field})
    between = [count for count in counts if 0 < count < STANDARD_POINTS]
    swept = [
        cell
        for cell in cells
        if set(counts) <= set(cell.field) and cell.fine() < cell.fine(points=0)
    ]
    if not between or not swept:
        return ""
    shares = []
    for count in between:
        given = [
            (cell.fine(points=0) - cell.fine(points=count)) / (cell.fine(points=0) - cell.fine())
            for cell in swept
        ]
        shares.append(f"{count}: {np.median(given):.0%}")
    return (
        f" Where they help, fewer give of that, in the median of {len(swept)} patterns, "
        f"{', '.join(shares)}."
    )


def _claim(cells: Sequence[Cell], checked: Sequence[Cell]) -> Claim:
    group = by_width(cells)[PAPER_WIDTH]
    advice = _advised(RIG, PAPER_WIDTH)
    fine, smooth = errors_at(group, advice.least_side_px)
    paper = next((cell for cell in group if cell.corners == PAPER_CORNERS), group[0])
    others = [_excess(each) for each in by_width(checked).values()]
    of_paper = f"{_um(paper.fine())} and {_um(paper.smooth())} um"
    check = f"; on other optics within {max(others) - 1:.0%} of the best" if others else ""
    return Claim(
        "beyond",
        f"which pattern to print: checkers of {RECOMMENDED_SIDE_PX:g} px at their smallest",
        "not studied (20 x 20 on 1024 x 768 px)",
        f"on 1024 x 768 px {advice.rows} x {advice.cols}: error of the field {_um(fine)} um fine, "
        f"{_um(smooth)} um smooth; 20 x 20: {of_paper}{check}",
        None,
    )


def _deviations() -> tuple[Deviation, ...]:
    return (
        Deviation(
            "camera of another resolution",
            "one camera of 1024 x 768 px",
            "chips of the same size with other pixels, behind the same lens; blur of 0.7 px at "
            "1024 px grows with the resolution, noise in a pixel (1 grey level) does not",
            "a real chip with finer pixels is noisier: the finest are flattered",
        ),
        Deviation(
            "gel",
            "pressed prototypes",
            "linear model, 0.5 MPa, a skin of 0.3 mm between contact and pattern, which blurs "
            "contacts before any pattern sees them",
            "a thinner skin shows finer detail, and rewards smaller checkers more; the finest "
            "contacts tried are beads of 1.2 mm",
        ),
    )


def _um(length: float) -> str:
    return f"{length * MICRO:.3g}" if np.isfinite(length) else MISSING


def _wave(cell: Cell) -> str:
    length = finest_wave(cell.gain[STANDARD_POINTS])
    return f"{length * MILLI:.2f}" if np.isfinite(length) else MISSING


def _range(values: Sequence[float]) -> str:
    return f"{min(values):.1f} to {max(values):.1f}"


EXPERIMENT = Experiment(
    key="pattern_choice",
    section="",
    title="Which pattern to print for a camera",
    cases=cases,
    report=report,
)
