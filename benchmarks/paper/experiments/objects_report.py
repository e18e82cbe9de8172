"""IV.C: tables, pictures as Fig. 10, claims."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap
from numpy.typing import NDArray

from paper import figure_style
from paper.blocks import Claim, Figure, Report, Table, deviations, prose
from paper.chain import CMP, CMP_PAPER, Method, mean_absolute
from paper.dot_tracking import ALL_METHODS
from paper.experiment import Arrays, Experiment, Results, number
from paper.experiments.objects import SCENES, cases

# The paper's figure for each object, m.
LIMIT = 20e-6
NAMES = {
    "contact_sphere": "sphere",
    "contact_cylinder": "cylinder, lying",
    "contact_cube_edge": "cube's edge",
    "contact_hexagonal_bar": "hexagonal bar",
    "contact_ring": "ring",
}
# Errors of displacement and of position lie next to each other in a case's arrays.
DISPLACEMENT, POSITION = 0, 1


def report(results: Results, folder: Path) -> Report:
    """What the five presses show."""
    pictures = contact_pictures(results, NAMES, folder / "objects_contact.png")
    over_press = error_over_press(results, NAMES, folder / "objects_press.png", LIMIT)
    blocks = (
        prose("objects", "setup"),
        _by_method(results),
        _by_axis(results),
        Figure(
            pictures,
            "As the paper's Fig. 10: what CMP reconstructs with its virtual markers at full press. "
            "Depth is below the gel at rest. The reconstructed height, at and between markers, is "
            f"off by {_height_error(results)}.",
        ),
        Figure(
            over_press,
            "Mean distance of the markers from their true places in every frame of the press.",
        ),
    )
    return Report(blocks, claims(results), deviations("objects"))


def _by_method(results: Results) -> Table:
    rows = []
    for scene in SCENES:
        data = results[scene]
        depth, force = -number(data, "depth") * 1e3, number(data, "normal_force")
        errors = (_micrometres(_distance(data, method)) for method in ALL_METHODS)
        rows.append((NAMES[scene], f"{depth:.2f} mm, {force:.2g} N", *errors))
    counted = tuple(_counts(results, method) for method in ALL_METHODS)
    return Table(
        ("object", "press", *(method.label for method in ALL_METHODS)),
        (*rows, ("markers found / wrong numbers", "", *counted)),
        "Mean absolute error of all markers at full press, as distance in space, um. CMP: corners "
        f"and virtual markers; DMP: dots. Mean of {_draws(results)} draws of noise. "
        "Paper: less than 20 um.",
    )


def _by_axis(results: Results) -> Table:
    rows = []
    for scene in SCENES:
        data = results[scene]
        for name, error in (
            ("corners, position", mean_absolute(data["cmp_errors"][:, POSITION])),
            ("virtual markers, position", np.mean(data["cmp_virtual"], axis=0)),
            ("corners, displacement", mean_absolute(data["cmp_errors"][:, DISPLACEMENT])),
        ):
            rows.append((NAMES[scene], name, *(_micrometres(value) for value in error)))
    return Table(
        ("object", "CMP", "x", "y", "z", "distance"),
        tuple(rows),
        "Mean absolute error by axis, um. Position is in the frame of the description; "
        "displacement is from the mean of four frames at rest.",
    )


def claims(results: Results) -> tuple[Claim, ...]:
    """The paper's figure beside that of CMP and of the paper's algorithm."""
    return tuple(_claim(results, method) for method in (CMP, CMP_PAPER))


def _claim(results: Results, method: Method) -> Claim:
    errors = [_distance(results[scene], method) for scene in SCENES]
    low, high = min(errors) * 1e3, max(errors) * 1e3
    found = _found(results, method)
    missing = "" if found == 1 else f", of the {found:.1%} of the markers that were found"
    return Claim(
        section="IV.C",
        what=f"mean absolute error of 3-D coordinates, each of five objects ({method.label})",
        paper="< 0.02 mm",
        ours=f"{low:.2g} to {high:.2g} mm{missing}",
        met=bool(all(error < LIMIT for error in errors)),
    )


def _height_error(results: Results) -> str:
    errors = [results[scene]["height"] - results[scene]["true_height"] for scene in SCENES]
    rms = [float(np.sqrt(np.nanmean(error**2))) for error in errors]
    most = max(float(np.nanmax(np.abs(error))) for error in errors)
    low, high = _micrometres(min(rms)), _micrometres(max(rms))
    return f"{low} to {high} um RMS, {_micrometres(most)} um at most"


def _distance(data: Arrays, method: Method) -> float:
    return float(np.mean(data[f"{method.key}_all"][:, 3]))


def _counts(results: Results, method: Method) -> str:
    wrong = sum(int(results[scene][f"{method.key}_counts"][:, 2].sum()) for scene in SCENES)
    return f"{_found(results, method):.1%} / {wrong}"


def _found(results: Results, method: Method) -> float:
    """Share of the visible corners or dots of all objects."""
    counts = np.concatenate([results[scene][f"{method.key}_counts"] for scene in SCENES])
    visible, found, _ = counts.sum(axis=0).tolist()
    return float(found / visible)


def _draws(results: Results) -> int:
    return len(results[SCENES[0]]["cmp_all"])


def _micrometres(metres: float) -> str:
    return f"{metres * 1e6:.3g}"


EXPERIMENT = Experiment(
    key="objects",
    section="IV.C",
    title="Five objects: 3-D coordinates of all markers",
    cases=cases,
    report=report,
)


Array = NDArray[np.float64]

ROWS = (
    "CMP, in 3-D",
    "true depth",
    "depth by CMP",
    "error of height",
    "displacement by CMP",
)
# Between arrows of the displacement field, in nodes of the dense surface.
ARROW_STEP = 8
# An arrow of so many um is as long as the way to the next one.
ARROW_UM = 40.0
# The error's colours end where so many per cent of the nodes lie beyond; those are counted.
ERROR_PERCENTILE = 99.5
ERROR_COLOURS = "RdBu_r"
# Of viridis, without the light end, in which arrows would not be seen.
LEAST_COLOUR, MOST_COLOUR = 0.8, 0.0


def contact_pictures(results: Results, names: Mapping[str, str], path: Path) -> Path:
    """As Fig. 10: a column for each object."""
    figure = figure_style.blank(9.6)
    deepest = max(float(np.nanmax(_depth(results[name], "true_height"))) for name in names)
    errors = np.concatenate([np.abs(_error(results[name])).ravel() for name in names])
    widest = float(np.nanpercentile(errors, ERROR_PERCENTILE))
    axes: dict[tuple[int, int], Axes] = {}
    for col, (scene, name) in enumerate(names.items()):
        data = results[scene]
        for row in range(len(ROWS)):
            spatial = {"projection": "3d"} if row == 0 else {}
            axis = figure.add_subplot(len(ROWS), len(names), row * len(names) + col + 1, **spatial)
            axes[row, col] = axis
        axes[0, col].set_title(name, fontsize=9)
        _draw_surface(axes[0, col], data, deepest)
        _draw_depth(axes[1, col], data, "true_height", deepest)
        _draw_depth(axes[2, col], data, "height", deepest)
        _draw_error(axes[3, col], data, widest)
        _draw_field(axes[4, col], data, deepest)
    _label(figure, axes, len(names), (deepest, widest))
    return figure_style.save(figure, path)


def error_over_press(results: Results, names: Mapping[str, str], path: Path, limit: float) -> Path:
    """Mean distance of all markers from the truth by frame, for every method; limit in m."""
    figure, axes = figure_style.panels(1, len(names), 2.9, sharey=True, squeeze=False)
    for axis, (scene, name) in zip(axes[0], names.items(), strict=True):
        for method in ALL_METHODS:
            error = np.mean(results[scene][f"{method.key}_frames"][..., 3], axis=0) * 1e6
            axis.semilogy(
                np.arange(1, len(error) + 1),
                error,
                label=method.label,
                markersize=3,
                **figure_style.look(method.key),
            )
        axis.axhline(
            limit * 1e6, color=figure_style.PAPER_COLOUR, linestyle="-.", label="paper: below"
        )
        axis.set_title(name, fontsize=9)
        axis.set_xlabel("frame of the press")
    axes[0, 0].set_ylabel("mean absolute error [um]")
    figure_style.legend(figure, axes[0, 0], len(ALL_METHODS) + 1)
    return figure_style.save(figure, path)


def _depth(data: Arrays, height: str) -> Array:
    """Below the gel at rest, mm."""
    return np.asarray((data["rest_height"] - data[height]) * 1e3, dtype=np.float64)


def _error(data: Arrays) -> Array:
    """Of the height, um."""
    return np.asarray((data["height"] - data["true_height"]) * 1e6, dtype=np.float64)


def _places(data: Arrays) -> tuple[Array, Array]:
    """Nodes' x and y, (cols,) and (rows,), mm."""
    rows, cols = data["height"].shape
    width, depth = data["extent"] * 1e3
    return np.linspace(-width / 2, width / 2, cols), np.linspace(-depth / 2, depth / 2, rows)


def _frame(data: Arrays) -> tuple[float, float, float, float]:
    x, y = _places(data)
    return float(x[0]), float(x[-1]), float(y[0]), float(y[-1])


def _depth_colours() -> Colormap:
    import matplotlib as mpl
    from matplotlib.colors import ListedColormap

    return ListedColormap(mpl.colormaps["viridis"](np.linspace(LEAST_COLOUR, MOST_COLOUR, 256)))


def _shaded(depth: Array, spacing: float, deepest: float) -> Array:
    """Colours (rows, cols, 4) of a depth map lit from the upper left."""
    from matplotlib.colors import LightSource, Normalize

    light = LightSource(azdeg=315, altdeg=45)
    height = -np.nan_to_num(depth)
    colours = _depth_colours()(Normalize(0, deepest)(depth))[..., :3]
    lit = light.shade_rgb(colours, height, blend_mode="soft", dx=spacing, dy=spacing)
    return np.where(np.isfinite(depth)[..., None], lit, 1.0)


def _draw_surface(axis: Axes, data: Arrays, deepest: float) -> None:
    x, y = np.meshgrid(*_places(data))
    depth, step = _depth(data, "height"), (slice(None, None, 3), slice(None, None, 3))
    colours = _shaded(depth, 0.1, deepest)
    axis.plot_surface(  # type: ignore[attr-defined]
        x[step],
        y[step],
        np.asarray(data["height"], dtype=np.float64)[step] * 1e3,
        facecolors=colours[step],
        rcount=60,
        ccount=60,
        linewidth=0,
        antialiased=False,
        shade=False,
    )
    axis.set_box_aspect((1, 1, 0.35), zoom=1.35)  # type: ignore[call-arg, arg-type]
    axis.view_init(elev=42, azim=-60)  # type: ignore[attr-defined]
    axis.set_axis_off()


def _draw_depth(axis: Axes, data: Arrays, height: str, deepest: float) -> None:
    axis.imshow(_shaded(_depth(data, height), 0.1, deepest), origin="lower", extent=_frame(data))


def _draw_error(axis: Axes, data: Arrays, widest: float) -> None:
    axis.imshow(
        _error(data),
        origin="lower",
        extent=_frame(data),
        cmap=ERROR_COLOURS,
        vmin=-widest,
        vmax=widest,
    )


def _draw_field(axis: Axes, data: Arrays, deepest: float) -> None:
    x, y = _places(data)
    first = (len(x) - 1) // 2 % ARROW_STEP
    step = slice(first, None, ARROW_STEP)
    moved = np.asarray(data["displacement"], dtype=np.float64)[step, step]
    arrows = axis.quiver(
        x[step],
        y[step],
        moved[..., 0] * 1e6,
        moved[..., 1] * 1e6,
        -moved[..., 2] * 1e3,
        cmap=_depth_colours(),
        clim=(0, deepest),
        angles="xy",
        scale_units="xy",
        scale=ARROW_UM / (ARROW_STEP * 0.1),
        width=0.009,
    )
    axis.quiverkey(
        arrows,
        0.82,
        -0.10,
        ARROW_UM,
        f"{ARROW_UM:.0f} um",
        labelpos="W",
        fontproperties={"size": 8},
    )
    axis.set_aspect("equal")


def _label(
    figure: Any, axes: dict[tuple[int, int], Axes], columns: int, scales: tuple[float, float]
) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    deepest, widest = scales
    for (row, col), axis in axes.items():
        axis.grid(visible=False)
        if row:
            axis.set_xticks([-5, 0, 5])
            axis.set_yticks([-5, 0, 5])
            axis.tick_params(labelsize=7, labelbottom=row == 3, labelleft=col == 0)
            if col == 0:
                axis.set_ylabel(f"{ROWS[row]}\ny [mm]", fontsize=8)
            if row == len(ROWS) - 2:
                axis.set_xlabel("x [mm]", fontsize=8, labelpad=1)
    axes[0, 0].text2D(  # type: ignore[attr-defined]
        -0.12, 0.5, ROWS[0], fontsize=8, rotation=90, va="center", transform=axes[0, 0].transAxes
    )
    depth = ScalarMappable(Normalize(0, deepest), _depth_colours())
    error = ScalarMappable(Normalize(-widest, widest), ERROR_COLOURS)
    for rows, scale, text, extend in (
        ((0, 1, 2), depth, "depth [mm]", "neither"),
        ((3,), error, "error [um]", "both"),
        ((4,), depth, "depth [mm]", "neither"),
    ):
        beside = [axes[row, col] for row in rows for col in range(columns)]
        shrink = 0.6 if len(rows) > 1 else 0.9
        figure.colorbar(scale, ax=beside, label=text, shrink=shrink, extend=extend, pad=0.01)
