"""Frames on which constants are tried: units of a few frames, each with figures and a digest.

Frames are rendered once, when the units are made. A unit makes its own trackers.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parent / name) for name in ("tracking", "force")]
import cv2
import numpy as np
from beyond_view import cases as cases_beyond_view
from beyond_view import sheet
from broken import BROKEN_KINDS, SILENT, Trial, misnumbered
from cases import NEO_HOOKEAN, load_cases, load_neo_hookean_cases
from coded import coded, shifted
from detectors import view_image
from errors import noisy, surface_of
from numpy.typing import NDArray

from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import (
    NS_PER_S,
    ForceField,
    ForceFlag,
    Grid,
    SlipState,
    Status,
)
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.tracking.tracker import GridTracker
from cmp_tactile_simulation.scenes.description import Hold, MoveBy, Phase, Release, Touch
from hard_frames.contacts import frames_of_ball
from hard_frames.covers import Cover, far_from_edge
from hard_frames.grid_score import displacement_errors, score_grid
from hard_frames.library import (
    CASE_KINDS,
    bad_views,
    cases_of,
    flawed_pairs,
    load_sample,
    misdescribed,
    sample_names,
    sequence_of,
)
from hard_frames.studio import PatternCase, PatternFrame, PatternStudio, bent

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Figures = dict[str, Any]
Unit = Callable[[], tuple[Figures, str]]
# Units whose names start so are only for constants that few units read.
RARE = "rare: "
# Frames of each sequence, and cases of a kind, where it is not two.
SEQUENCES = {
    "released": slice(1, 6),
    "light switched": slice(9),
    "hidden for a while": slice(0, 8, 2),
    "shifted": slice(2, 8),
}
MOST_CASES = {"clean": 7, "hidden": 6, "other rigs": 6}
# Contacts: frames without one, the way to it, time between frames.
REST_FRAMES, CLEARANCE_M, STEP_NS = 4, 5e-5, NS_PER_S // 15
BROKEN_TRIALS, COMMON_TRIALS = 16, 3


def digest(*results: Any) -> str:
    """A text that differs where any result does, in any bit."""
    return hashlib.sha256(b"".join(map(_bytes, results))).hexdigest()


def _bytes(value: Any) -> bytes:
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if is_dataclass(value):
        return b"".join(_bytes(getattr(value, part.name)) for part in fields(value))
    if isinstance(value, (list, tuple)):
        return b"".join(map(_bytes, value))
    return repr(value).encode() if isinstance(value, (float, int, str, type(None))) else b""


# Figures of results that were seen before the process was forked, by their digest.
_known: dict[str, Figures] = {}


def judged(results: Sequence[Any], judge: Callable[[], Iterable[Figures]]) -> tuple[Figures, str]:
    """The sum of all figures, and the digest of all results; equal results are judged once."""
    key = digest(*results)
    if key not in _known:
        total: Figures = {}
        for figures in judge():
            total = {name: total.get(name, 0) + value for name, value in figures.items()}
        _known[key] = total
    return _known[key], key


def squares(errors: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Sum of squares, and their number."""
    return np.array([(errors**2).sum(), errors.size])


def score(grid: Grid, frame: PatternFrame, view: str) -> Figures:
    """Of one view: what is found, wrong and refused, and errors."""
    truth, visible, far = frame.truth[view], frame.visible[view], frame.far[view]
    if frame.sensor.pattern.border == "beyond_view":
        size = view_image(frame, view).shape
        visible = far = far & far_from_edge(truth.corners, (size[0], size[1]))
    found = score_grid(grid, truth, visible, far)
    error = np.linalg.norm(grid.corners - truth.corners, axis=-1)
    right = (grid.corner_status == Status.MEASURED) & visible & (error < 1.0)
    return {
        "corners": found.found_visible,
        "predicted": found.filled,
        "wrong": found.wrong,
        "refused": int(grid.fault not in SILENT),
        "corner error": squares(found.corner),
        "marker error": squares(found.virtual),
        "error/deviation": squares((error / grid.corner_std)[right]),
    }


def followed(frames: Sequence[PatternFrame], number: int = 0) -> tuple[Figures, str]:
    """One view of all frames, in turn; number: of the view."""
    sensor, view = frames[0].sensor, list(frames[0].truth)[number % 2]
    tracker = GridTracker(sensor, view)
    grids = [tracker.track(view_image(frame, view)) for frame in frames]
    return judged(grids, lambda: map(score, grids, frames, [view] * len(grids)))


def inspected(rest: PatternFrame, frame: PatternFrame) -> tuple[Figures, str]:
    """One view after its print was inspected; the error is that of the displacement."""
    view = next(iter(rest.truth))
    tracker = GridTracker(rest.sensor, view)
    defects = tracker.inspect_print([view_image(rest, view)])
    grids = []
    for item in (rest, frame):
        tracker.reset()
        grids.append(tracker.track(view_image(item, view)))

    def judge() -> Iterable[Figures]:
        visible = rest.visible[view] & frame.visible[view]
        pairs = list(zip(grids, (rest.truth[view], frame.truth[view]), strict=True))
        doubtful = int(defects.row_line_doubtful.sum() + defects.col_line_doubtful.sum())
        yield score(grids[1], frame, view) | {
            "corner error": squares(displacement_errors(*pairs, visible)),
            "flawed": int((defects.corner_weight < 1).sum()),
            "doubtful": doubtful,
            "corner weights": squares(defects.corner_weight),
        }

    return judged([*grids, defects], judge)


def refused(sensor: SensorDescription, image: np.ndarray[Any, Any]) -> tuple[Figures, str]:
    """A view that shows another pattern than the one described: any corner is wrong."""
    grid = GridTracker(sensor, "left").track(image)
    wrong = int((grid.corner_status != Status.MISSING).sum())
    return judged([grid], lambda: [{"wrong": wrong, "refused": int(bool(grid.fault.value))}])


def broken(frame: PatternFrame, trial: Trial, number: int) -> tuple[Figures, str]:
    """A spoilt frame; a wrong number counts where no fault says so."""
    view = list(frame.truth)[number % 2]
    tracker = GridTracker(frame.sensor, view)
    place = frame.truth[view].placement
    grid = [tracker.track(split_frame(image, place)) for image in trial.images][-1]

    def judge() -> Iterable[Figures]:
        wrong, right = misnumbered(grid, trial.places)
        loud = grid.fault not in SILENT
        silent = not loud and grid.confidence > trial.doubted
        yield {"corners": right, "wrong": wrong * silent, "refused": int(loud)}

    return judged([grid], judge)


class Tracking:
    """Units of the tracker.  data: folder of sample frames with truth."""

    def __init__(self, data: Path | None) -> None:
        cv2.setNumThreads(1)
        self._studio, self._sensor = PatternStudio(2), load_sensor("sample_rig")
        self._clean = [self._studio.photograph(case) for case in cases_of("clean", self._sensor)]
        self.units: dict[str, Unit] = {}
        self._add_kinds()
        self._add_flawed_prints()
        self._add_bad_input()
        self._add_coded()
        self._add_beyond_view()
        self._add_stitched()
        if data is not None:
            self._add_samples(data)

    def _add(self, name: str, *cases: PatternCase | PatternFrame) -> None:
        frames = [
            case if isinstance(case, PatternFrame) else self._studio.photograph(case)
            for case in cases
        ]
        self.units[name] = partial(followed, frames, len(self.units))

    def _add_kinds(self) -> None:
        for kind in CASE_KINDS:
            for case in cases_of(kind, self._sensor)[: MOST_CASES.get(kind, 2)]:
                self._add(f"{kind}: {case.name}", case)
        for kind, chosen in SEQUENCES.items():
            self._add(kind, *sequence_of(kind, self._sensor)[chosen])

    def _add_flawed_prints(self) -> None:
        for seed in range(2):
            for number, pair in enumerate(flawed_pairs(self._sensor, seed)):
                name = f"{RARE if seed else ''}flawed print {number} {seed}"
                self.units[name] = partial(inspected, *map(self._studio.photograph, pair))

    def _add_bad_input(self) -> None:
        image = view_image(self._clean[0], "left")
        for name, bad in bad_views(image).items():
            self.units[f"bad: {name}"] = partial(refused, self._sensor, bad)
        for name, rig in misdescribed(self._sensor).items():
            self.units[f"described: {name}"] = partial(refused, rig, image)
        for kind, spoil in BROKEN_KINDS.items():
            for index in range(BROKEN_TRIALS):
                trial = spoil(self._clean, np.random.default_rng(index))
                name = f"{RARE if index >= COMMON_TRIALS else ''}{kind} {index}"
                self.units[name] = partial(broken, self._clean[0], trial, index)

    def _add_coded(self) -> None:
        dots = coded(self._sensor)
        for number, shape in enumerate(("left", "band_down", "disc")):
            kind = ("rest", "slide")[number % 2]
            self._add(f"dots: {shape}", bent(dots, kind, number, cover=Cover(shape, 0.6)))
        twisted = self._studio.photograph(bent(dots, "twist"))
        for slide in ((40, -60), (-120, 130)):
            self._add(f"dots: slid {slide}", shifted(twisted, slide))

    def _add_beyond_view(self) -> None:
        for code in ("none", "dots"):
            whole = sheet(code)
            rest = self._studio.photograph(PatternCase("rest", whole))
            for place, (name, cases) in enumerate(cases_beyond_view(whole).items()):
                for number, case in enumerate(cases[1::5]):
                    rare = RARE if number or place % 2 else ""
                    self._add(f"{rare}sheet {code}: {name} {number}", rest, case)

    def _add_stitched(self) -> None:
        method = replace(self._sensor.tracking, detector="contour_stitching")
        sensor = replace(self._sensor, tracking=method)
        for kind in CASE_KINDS:
            if kind != "other rigs":
                self._add(f"{RARE}stitched: {kind}", cases_of(kind, sensor)[-1])

    def _add_samples(self, data: Path) -> None:
        rig = load_sensor(data / "sensor.yaml")
        for name in sample_names(data, "still"):
            self._add(name, load_sample(rig, data, name))
        worn = (load_sample(rig, data, f"still/worn_{name}") for name in ("rest", "slide"))
        self.units["still/worn"] = partial(inspected, *worn)
        names = sample_names(data, "grasp")[31:35]
        self._add("grasp", *(load_sample(rig, data, name) for name in names))


def pressed(
    sensor: SensorDescription, rest: Sequence[Image], images: Sequence[Image], forces: Array
) -> tuple[Figures, str]:
    """The whole chain over images of a contact, at 30 Hz after a zero; its true forces (n, 3) N."""
    pipeline = Pipeline(sensor)
    pipeline.set_reference(rest)
    found = [pipeline.process(image, index * STEP_NS) for index, image in enumerate(images)]
    return judged(found, lambda: map(of_force, [item.force for item in found], forces))


def of_force(found: ForceField, true: Array) -> Figures:
    """Errors of a force, and its flags."""
    error = found.wrench[:3] - true
    flags = {flag.name.lower(): int(flag in found.flags) for flag in ForceFlag if flag.name}
    return flags | {
        "force error": squares(error),
        "error/deviation": squares(error / found.wrench_std[:3]),
        "contact nodes": int(found.contact.sum()),
        "slipping": int(found.slip.state in {SlipState.INCIPIENT, SlipState.FULL}),
    }


def slid(sensor: SensorDescription, moved: Sequence[Array], forces: Array) -> tuple[Figures, str]:
    """Force and slip of displacements of the markers (n, rows, cols, 3), m."""
    stage = ForceStage(sensor)
    found = [stage.process(surface_of(sensor, item)) for item in moved]
    return judged(found, lambda: map(of_force, found, forces))


def force_units() -> dict[str, Unit]:
    """A rendered slide through the whole chain, and displacements with noise."""
    cv2.setNumThreads(1)
    sensor = load_sensor("sample_rig")
    images, forces = frames_of_ball(
        sensor,
        Touch((5e-4, -3e-4), CLEARANCE_M),
        Phase("rest", REST_FRAMES, Hold()),
        Phase("close", 4, MoveBy((0.0, 0.0, -3e-4 - CLEARANCE_M))),
        Phase("drag", 6, MoveBy((2e-3, 1e-3, 0.0))),
        Phase("open", 2, Release(3e-4)),
    )
    rest, chosen = images[:REST_FRAMES], slice(REST_FRAMES - 1, None, 3)
    units: dict[str, Unit] = {
        "slide": partial(pressed, sensor, rest, images[chosen], forces[chosen])
    }
    # Two balls and a shear, then a shear and a flat pin that press deep.
    for case in [*load_cases(sensor)[27:50:22], *load_neo_hookean_cases(sensor)[7::4]]:
        model = "neo_hookean" if case.material == NEO_HOOKEAN else "linear"
        rig = replace(sensor, elastomer=replace(sensor.elastomer, model=model))
        name = f"{case.name}, {case.newton:.1f} N, {case.material}"
        true = np.repeat(case.wrench[None, :3], 2, axis=0)
        units[name] = partial(slid, rig, noisy(case, 2), true)
    return units


UNITS: dict[str, Callable[[Path | None], dict[str, Unit]]] = {
    "tracking": lambda data: Tracking(data).units,
    "force": lambda _: force_units(),
}
