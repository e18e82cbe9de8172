"""What section V.B comes to: how well a sphere fitted to the markers gives the ball."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from cmp_tactile_simulation.scenes.file import load_scene
from paper import figure_style
from paper.blocks import Claim, Figure, Report, Table, Text, deviations, prose
from paper.experiment import Arrays, Experiment, Results, number
from paper.experiments.balls import DEPTH_SHARE, REPETITIONS, cases
from paper.readings import MEASURED, READINGS, Reading, name_of

# A difference is clear from so many of its standard errors on.
CLEAR = 2.0


@dataclass(frozen=True)
class BallFits:
    """Fits of one reading; ball (B,) diameters in m, others (B, presses).

    diameter, rms: m; count: of markers; exact: diameter fitted to the true places of the markers
    that the reading takes, m.
    """

    ball: NDArray[np.float64]
    diameter: NDArray[np.float64]
    rms: NDArray[np.float64]
    count: NDArray[np.float64]
    exact: NDArray[np.float64]

    @classmethod
    def from_results(cls, results: Sequence[Arrays], reading: str, exact: str) -> BallFits:
        """From the arrays of `balls.fit_balls`, balls in rising order."""
        rows = sorted(results, key=lambda arrays: number(arrays, "ball"))

        def all_of(name: str) -> NDArray[np.float64]:
            return np.array([np.asarray(arrays[name], np.float64).ravel() for arrays in rows])

        return cls(
            np.array([number(arrays, "ball") for arrays in rows]),
            all_of(f"{reading}_diameter"),
            all_of(f"{reading}_rms"),
            all_of(f"{reading}_count"),
            all_of(f"{exact}_diameter"),
        )

    @property
    def from_ball(self) -> NDArray[np.float64]:
        """Fitted minus the ball's diameter, m."""
        return np.asarray(self.diameter - self.ball[:, None])

    @property
    def from_exact(self) -> NDArray[np.float64]:
        """Fitted minus the diameter that exact markers give, m."""
        return np.asarray(self.diameter - self.exact)

    def beside_layer(self, layer: float) -> NDArray[np.float64]:
        """Fitted minus the ball's diameter, with the markers a layer (m) farther out, m."""
        return np.asarray(self.from_ball - 2 * layer)

    @property
    def failed(self) -> int:
        """Presses that gave no sphere."""
        return int(np.count_nonzero(np.isnan(self.diameter)))


def clearly_less(
    first: NDArray[np.float64], second: NDArray[np.float64], repetitions: int = 1
) -> bool:
    """Whether the first of paired deviations are smaller in size, by more than chance makes them.

    The mean of |first| - |second| lies below zero by more than CLEAR of its standard errors.
    repetitions: so many presses in a row differ in noise alone and are averaged, as they share
    what place and ball do.  Presses without a fit are left out of both.
    """
    difference = (np.abs(first) - np.abs(second)).reshape(-1, repetitions).mean(axis=1)
    difference = difference[np.isfinite(difference)]
    if len(difference) < 2:
        return False
    error = float(np.std(difference, ddof=1)) / len(difference) ** 0.5
    return bool(difference.mean() < -CLEAR * error)


Fits = Mapping[Reading, BallFits]


def report(results: Results, folder: Path) -> Report:
    """Figure, tables and claims."""
    fits = fits_of(results)
    measured = {reading: fits[reading] for reading in MEASURED}
    exact, exact_corners = (_by_key(fits, key) for key in ("exact", "exact_corners"))
    layer = load_scene("ball:10mm").sensor.elastomer.shading_layer.thickness
    figure = draw_fits(measured, (exact, exact_corners), folder / "balls_diameters.png")
    blocks = (
        _setup(layer),
        Figure(
            figure,
            "As Fig. 14 (b): fitted diameters against the balls', the same against the fit to the "
            "exact places of the same markers, and the RMS distance of the markers from their "
            "sphere. Points: mean over the presses of a ball; bars: standard deviation over them.",
        ),
        _summary(fits, layer),
        _by_ball(fits),
    )
    return Report(blocks, claims(fits), deviations("balls"))


def fits_of(results: Results) -> Fits:
    """By reading."""
    arrays = list(results.values())
    return {r: BallFits.from_results(arrays, r.key, _exact_key(r)) for r in READINGS}


def _exact_key(reading: Reading) -> str:
    return "exact_corners" if reading.corners_only else "exact"


def _by_key(fits: Fits, key: str) -> BallFits:
    return next(fit for reading, fit in fits.items() if reading.key == key)


def _setup(layer: float) -> Text:
    return prose("balls", "setup", share=DEPTH_SHARE, layer=1000.0 * layer)


def _percent(fit: BallFits, deviation: NDArray[np.float64]) -> float:
    """Mean size of deviations, % of the ball."""
    return float(100 * np.nanmean(np.abs(deviation) / fit.ball[:, None]))


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _summary(fits: Fits, layer: float) -> Table:
    def if_measured(reading: Reading, text: str) -> str:
        return "" if reading.method is None else text

    columns: dict[str, Callable[[Reading, BallFits], str]] = {
        "reading": lambda reading, _: name_of(reading),
        "markers in a fit": lambda _, fit: f"{np.mean(fit.count):.0f}",
        "|fitted - ball|, %": lambda _, fit: f"{_percent(fit, fit.from_ball):.2f}",
        "less twice the layer, %": lambda _, fit: f"{_percent(fit, fit.beside_layer(layer)):.2f}",
        "|fitted - exact|, %": lambda reading, fit: if_measured(
            reading, f"{_percent(fit, fit.from_exact):.2f}"
        ),
        "mean of fitted - exact, mm": lambda reading, fit: if_measured(
            reading, f"{1e3 * np.nanmean(fit.from_exact):+.3f}"
        ),
        "RMS of fitted - exact, mm": lambda reading, fit: if_measured(
            reading, f"{1e3 * _rms(fit.from_exact):.3f}"
        ),
        "RMS of the fit, um": lambda _, fit: f"{1e6 * np.nanmean(fit.rms):.2f}",
        "no sphere": lambda _, fit: f"{fit.failed}",
    }
    caption = f"All balls and presses together ({fits[READINGS[0]].diameter.size})."
    return Table.from_columns(columns, fits.items(), caption)


def _by_ball(fits: Fits) -> Table:
    chosen = ("exact", "exact_corners", "cmp", "cmp_corners", "cmp_paper", *_dots(fits))
    columns = {key: _by_key(fits, key) for key in chosen}
    labels = {reading.key: name_of(reading) for reading in fits}
    head = ("ball, mm", *(labels[key] for key in chosen))
    balls = columns["exact"].ball
    rows = tuple(
        (
            f"{1e3 * ball:.0f}",
            *(_mean_and_spread(1e3 * fit.diameter[row]) for fit in columns.values()),
        )
        for row, ball in enumerate(balls)
    )
    caption = "Fitted diameters, mm: mean and, in brackets, standard deviation over the presses."
    return Table(head, rows, caption)


def _mean_and_spread(values: NDArray[np.float64]) -> str:
    return f"{np.nanmean(values):.2f} ({np.nanstd(values):.2f})"


def _dots(fits: Fits) -> list[str]:
    """Keys of the readings of dots."""
    return [r.key for r in fits if r.method is not None and r.method.pattern_type == "dmp"]


def _best_dots(fits: Fits) -> BallFits:
    """The reading of dots with the least error of measurement."""
    return min((_by_key(fits, key) for key in _dots(fits)), key=lambda fit: _rms(fit.from_exact))


def claims(fits: Fits) -> tuple[Claim, ...]:
    """What the paper says of precision beside what was measured."""
    cmp, corners, dots = _by_key(fits, "cmp"), _by_key(fits, "cmp_corners"), _best_dots(fits)
    return (
        Claim(
            "V.B",
            "Fitted diameters deviate less from the balls' with CMP than with DMP (raw)",
            "less (figure only)",
            f"{_percent(cmp, cmp.from_ball):.2f} % against {_percent(dots, dots.from_ball):.2f} % "
            f"on average; exact markers "
            f"{_percent(cmp, _by_key(fits, 'exact').from_ball):.2f} %",
            clearly_less(cmp.from_ball, dots.from_ball, REPETITIONS),
        ),
        Claim(
            "V.B",
            "Error of measurement: fitted against the fit to exact markers, CMP below DMP",
            "less (figure only)",
            f"{_percent(cmp, cmp.from_exact):.2f} % against "
            f"{_percent(dots, dots.from_exact):.2f} % on average",
            clearly_less(cmp.from_exact, dots.from_exact, REPETITIONS),
        ),
        Claim(
            "V.B",
            "Virtual markers make the fit more accurate",
            "more accurate (no figure)",
            f"RMS {1e3 * _rms(cmp.from_exact):.3f} mm with {np.mean(cmp.count):.0f} markers, "
            f"{1e3 * _rms(corners.from_exact):.3f} mm with {np.mean(corners.count):.0f} corners",
            clearly_less(cmp.from_exact, corners.from_exact, REPETITIONS),
        ),
    )


EXPERIMENT = Experiment(
    key="balls",
    section="V.B",
    title="Precision: spheres fitted to balls",
    cases=cases,
    report=report,
)


# Methods beside each other at one ball, over this width, mm.
SPREAD_MM = 0.55


def draw_fits(
    fits: Mapping[Reading, BallFits], exact: tuple[BallFits, BallFits], path: Path
) -> Path:
    """Deviation from the ball, from what exact markers give, and RMS of the fits.

    exact: with virtual markers and of corners alone.
    """
    height = 0.75 * figure_style.WIDTH_IN
    figure, axes = figure_style.panels(3, 1, height, sharex=True, height_ratios=(1.3, 1.1, 0.9))
    ball_mm = 1e3 * exact[0].ball
    for offset, (reading, fit) in zip(np.linspace(-0.5, 0.5, len(fits)), fits.items(), strict=True):
        at = ball_mm + SPREAD_MM * offset
        look = _look(reading)
        share = 100 / fit.ball[:, None]
        _bars(axes[0], at, share * fit.from_ball, {**look, "label": name_of(reading)})
        _bars(axes[1], at, share * fit.from_exact, look)
        _bars(axes[2], at, 1e6 * fit.rms, look)
    for truth, style, label in zip(
        exact, ("-", ":"), ("exact markers, virtual ones included", "exact corners"), strict=True
    ):
        deviation = 100 * np.nanmean(truth.from_ball, axis=1) / truth.ball
        axes[0].plot(ball_mm, deviation, style, color=figure_style.TRUE_COLOUR, label=label)
    for axis in axes[:2]:
        axis.axhline(0, color=figure_style.PAPER_COLOUR, linewidth=0.8)
    axes[0].set_ylabel("fitted - ball,\n% of the ball")
    axes[1].set_ylabel("fitted - fit to exact\nmarkers, % of the ball")
    axes[2].set_ylabel("RMS distance of\nmarkers, um")
    axes[2].set_ylim(bottom=0)
    axes[2].set_xticks(ball_mm)
    axes[2].set_xlabel("diameter of the ball, mm")
    figure.legend(loc="outside lower center", ncols=3)
    return figure_style.save(figure, path)


def _look(reading: Reading) -> dict[str, Any]:
    method = "cmp" if reading.method is None else reading.method.key
    dots = reading.method is not None and reading.method.pattern_type == "dmp"
    return {
        "color": figure_style.COLOURS[method],
        "marker": figure_style.MARKERS[method],
        "fillstyle": "none" if reading.corners_only and not dots else "full",
    }


def _bars(
    axis: Axes, at: NDArray[np.float64], values: NDArray[np.float64], look: Mapping[str, Any]
) -> None:
    """Mean over the presses of each ball, and their standard deviation as a bar."""
    axis.errorbar(
        at,
        np.nanmean(values, axis=1),
        np.nanstd(values, axis=1),
        linestyle="none",
        markersize=4,
        elinewidth=1,
        **look,
    )
