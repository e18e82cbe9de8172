"""A first description of a sensor, from one picture of its pattern at rest.

The corners are counted in the picture, or in both parts of it where two views lie side by side.
Whether the views are mirrored only dots show: a plain checkerboard looks the same in a mirror.
Where the cameras are follows from them: how a tilted pattern shrinks with distance shows the focal
length, and two views show how the surface is curved.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.calibration.counting import (
    ANGLE_DEG,
    Image,
    Sighting,
    assumed_elastomer,
    count_corners,
    focal_px,
)
from cmp_tactile_processing.calibration.map_fit import map_fit
from cmp_tactile_processing.errors import FrameError, InputError
from cmp_tactile_processing.geometry.optics import FLIP_X, build_views, reflection
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor import parts
from cmp_tactile_processing.sensor.description import VIEW_NAMES, SensorDescription
from cmp_tactile_processing.sensor.dot_code import LARGEST_SHEET, dot_map
from cmp_tactile_processing.tracking.dots import Decoding, DotDecoder
from cmp_tactile_processing.tracking.tracker import GridTracker

Float = NDArray[np.float64]
Choose = Callable[[str, tuple[str, ...]], str]

# What a frame holds: a view, two that mirrors show, or two of cameras that are joined to a frame.
LAYOUTS = ("one", "mirrors", "cameras")
# What is asked of one view, and of two.
MEANT = {
    "one": "the camera looks at the gel directly",
    "cameras": "one camera and two mirrors, or two cameras",
}
# The frame is cut as near to its middle as there are no saddles of grey levels, smoothed by so many
# px, over so many px: less of them than such a share of what lines have on average.
SADDLE_PX, CUT_PX, FREE_SHARE = 2.0, 15, 0.1
# A description has so many rows and columns at least and, with a border in sight, at most.
LEAST_LINES, MOST_LINES = parts.MIN_CORNERS, parts.MAX_CORNERS
# Where the description that is made finds fewer corners again, it is none.
FOUND_AGAIN = 0.9
# Of the corners, px; how far the focal length may be from the usual one, as a factor; curvature of
# the surface in units of the pattern's half width; and distortion.  Values that all views share.
CORNER_PX, FOCAL_FACTOR, CURVATURE, DISTORTION = 1.0, 1.35, 0.5, 0.2
SHARED = 3
# Focal lengths that a camera may have, over the width of the frame.
FOCAL = 0.12, 12.0
# Poses begin near the truth: a turn, rad, and a shift as share of the distance.
TURN_RAD, SHIFT = 0.5, 0.5
# A surface that sags less than this share of a checker is a plane.
LEAST_SAG = 0.1
# Two mirrors show views that are turned against one another by more than this.
LEAST_TURN_RAD = 0.02


@dataclass(frozen=True)
class View:
    """A view that was found: its part of the frame, and what is seen there, in px of the part."""

    roi: parts.Roi
    seen: Sighting


@dataclass(frozen=True)
class Proposal:
    """A description, and what the picture is worth: by view the grid that its tracker finds, and
    what it was counted from.

    layout: one of LAYOUTS.  misfit_px: root mean square distance of the corners from where the
    description has them.  note: of dots that the description does not have; or empty.
    """

    sensor: SensorDescription
    layout: str
    misfit_px: float
    grids: Mapping[str, Grid]
    views: Mapping[str, View]
    note: str


@dataclass(frozen=True)
class Known:
    """What no picture shows.

    pitch: side of a checker, m.  angle_of_view: of the camera, horizontally, degrees; where it is
    None, the one that explains how the pattern is tilted, or the usual one where it is not.
    code_seed: of the dots, if there are any.
    """

    pitch: float
    angle_of_view: float | None = None
    code_seed: int = 0


def find_views(image: Image, layout: str = "") -> tuple[View, ...]:
    """The views that a picture (H, W) uint8 holds: one, or the left and the right one.

    layout: one of LAYOUTS, or empty for what is seen.  Raises FrameError where that is not seen.
    """
    height, width = image.shape
    if layout != "one":
        cut = _cut(image)
        rois = parts.Roi(0, 0, cut, height), parts.Roi(cut, 0, width - cut, height)
        left, right = np.split(image, [cut], axis=1)
        try:
            first = View(rois[0], count_corners(np.ascontiguousarray(left), "left view"))
            # Of one pattern that is cut, neither part ends at the cut.
            if layout or first.seen.ends[-1]:
                second = View(rois[1], count_corners(np.ascontiguousarray(right), "right view"))
                if layout or second.seen.ends[-2]:
                    return first, second
        except (FrameError, InputError):
            # Too few checkers, or a strip of the picture too narrow for any.
            if layout:
                raise
    return (View(parts.Roi(0, 0, width, height), count_corners(image)),)


def _cut(image: Image) -> int:
    """The column between two patterns."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), SADDLE_PX)
    xx, yy, xy = (cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((2, 0), (0, 2), (1, 1)))
    saddles = np.maximum(xy * xy - xx * yy, 0.0).sum(axis=0)
    width = len(saddles)
    place = np.arange(width // 4, width - width // 4)
    inside = np.convolve(saddles, np.ones(CUT_PX), "same")[place] / CUT_PX
    free = place[inside <= inside.min() + FREE_SHARE * saddles.mean()]
    return int(free[np.abs(free - width / 2).argmin()])


def _check_alike(views: Sequence[View]) -> None:
    """Raise FrameError unless both views show the whole pattern."""
    whole = all(all(view.seen.ends) for view in views)
    if whole and len({view.seen.size_text for view in views}) == 1:
        return
    texts = [
        f"{view.seen.size_text} in the {name} view"
        + ("" if all(view.seen.ends) else ", and more beyond its edge")
        for name, view in zip(VIEW_NAMES, views, strict=True)
    ]
    msg = (
        f"picture: found {' and '.join(texts)}, expected the same number in both views, and the "
        "whole pattern with a margin around it; for a part of a pattern use --views one"
    )
    raise FrameError(msg)


def propose(
    image: Image, known: Known, name: str, layout: str = "", choose: Choose | None = None
) -> Proposal:
    """The proposal for a picture (H, W) uint8 of a pattern.

    layout: one of LAYOUTS, or empty for what dots show.  choose: returns the layout where nothing
    shows it, from why it is not known and the possible ones.
    Raises FrameError where no checkers are seen, too few, or not the same in both views, where
    dots contradict the layout, and where nothing shows it and there is no `choose`.
    """
    views = find_views(image, layout)
    if len(views) == 1:
        _check_lines(views[0].seen)
    else:
        _check_alike(views)
    layout = _layout_by_dots(views, layout, known.code_seed, choose)
    size = parts.ImageSize(image.shape[1], image.shape[0])
    rig = _fitted(size, views, layout, known)
    if not FOCAL[0] < rig.focal / size.width < FOCAL[1]:
        msg = (
            f"picture: found no pose of {rig.layout} that fits (corners are off by "
            f"{rig.misfit_px:.1f} px), expected another --views or --angle-of-view"
        )
        raise FrameError(msg)
    sensor = _described(size, rig, name)
    grids = {}
    for view_name, geometry in build_views(sensor).items():
        grid = GridTracker(sensor, view_name).track(split_frame(image, geometry.placement))
        if grid.found_fraction < FOUND_AGAIN:
            rows, cols = grid.shape.corners
            msg = (
                f"picture: found {rows} x {cols} corners, of which the tracker finds "
                f"{grid.found_fraction:.0%} with the proposed description in the {view_name} view "
                f"({grid.reason}), expected {FOUND_AGAIN:.0%}"
            )
            raise FrameError(msg)
        grids[view_name] = grid
    found = dict(zip(VIEW_NAMES, views, strict=False))
    note = _note_of_dots(views, sensor.pattern, known.code_seed)
    return Proposal(sensor, rig.layout, rig.misfit_px, grids, found, note)


def _place_on_sheet(seen: Sighting, seed: int) -> Decoding | None:
    """Where on the largest sheet dots lie; None where they do not show that for certain."""
    if not seen.dots.bits.any():
        return None
    decoder = DotDecoder(dot_map(LARGEST_SHEET, LARGEST_SHEET, seed), dark_first=True)
    found = decoder.decode(seen.dots.bits, seen.even)
    return found if found is not None and found.is_certain else None


def _layout_by_dots(views: Sequence[View], given: str, seed: int, choose: Choose | None) -> str:
    """The layout that dots show, or the given one where there are none."""
    plain, possible = ("one", ("one",)) if len(views) == 1 else ("cameras", LAYOUTS[1:])
    places = [_place_on_sheet(view.seen, seed) for view in views]
    shown = {"mirrors" if place.mirrored else plain for place in places if place is not None}
    if not shown:
        if given:
            return given
        options = " or ".join(f"--views {layout}" for layout in possible)
        msg = (
            "picture: found a pattern without dots, which looks the same in a mirror; expected "
            f"{options} ({MEANT[plain]})"
        )
        if choose is not None:
            return choose(msg, possible)
        raise FrameError(msg)
    layout = shown.pop()
    if shown or layout not in possible or given not in ("", layout):
        mirrored = "mirrored" if layout == "mirrors" else "not mirrored"
        seen = "mirrored in one view" if shown else mirrored
        msg = (
            f"picture: found dots that are {seen}, expected those of --views "
            f"{given or ' or '.join(possible)}; if that is right, the print is the wrong way round "
            "(docs/print.md), or the camera mirrors its pictures"
        )
        raise FrameError(msg)
    return layout


def _note_of_dots(views: Sequence[View], pattern: parts.Pattern, seed: int) -> str:
    """What is to be said of dots that are seen, and not described."""
    if pattern.code != "none" or not any(view.seen.dots.is_code for view in views):
        return ""
    if _place_on_sheet(views[0].seen, seed) is None:
        return f"the checkers have dots, but not those of seed {seed}: give --code-seed"
    return "a part of the sheet is seen, so its dots are not used: show the whole pattern"


def _check_lines(seen: Sighting) -> None:
    # Two more: a pattern that goes on beyond the picture loses a line at each side.
    if min(seen.corners.shape[:2]) < LEAST_LINES + 2:
        msg = (
            f"picture: found {seen.size_text}, expected at least {LEAST_LINES + 2} along each side"
        )
        raise FrameError(msg)


@dataclass(frozen=True)
class _Rig:
    """Where pattern and cameras are: T_view_gel (4, 4) of each roi's un-mirrored view."""

    layout: str
    rois: tuple[parts.Roi, ...]
    pattern: parts.Pattern
    focal: float
    bend: float
    poses: tuple[Float, ...]
    misfit_px: float


def _fitted(size: parts.ImageSize, views: Sequence[View], layout: str, known: Known) -> _Rig:
    """The rig that explains the corners best."""
    seen = [view.seen for view in views]
    if layout == "mirrors":
        seen = [view.seen.mirrored(view.roi.width) for view in views]
    pattern, corners = _pattern_of([_upright(item, known.code_seed) for item in seen], known)
    angle = known.angle_of_view
    rois = tuple(view.roi for view in views)
    # An angle that is given is that of each camera.
    usual = focal_px(rois[0].width if layout == "cameras" else size.width, angle or ANGLE_DEG)
    fit = _Fit(pattern, corners, [_centre(size, roi, layout) for roi in rois], usual)
    values, misfit = fit.best(fixed=angle is not None)
    focal = float(round(usual * np.exp(values[0]), 1))
    half, curvature = fit.half, float(values[1])
    if curvature * half / 2 > LEAST_SAG * pattern.pitch:
        surface = parts.PatternSurface("sphere_cap", float(f"{half / curvature:.3g}"))
        pattern = replace(pattern, surface=surface)
    poses = tuple(_pose(values[k : k + 6]) for k in range(SHARED, len(values), 6))
    return _Rig(layout, rois, pattern, focal, float(round(values[2], 4)), poses, misfit)


def _upright(seen: Sighting, seed: int) -> Sighting:
    """With rows and columns as on the sheet, as far as dots show that."""
    place = _place_on_sheet(seen, seed)
    return seen if place is None else seen.turned(-place.turns)


def _pattern_of(seen: Sequence[Sighting], known: Known) -> tuple[parts.Pattern, list[Float]]:
    """The pattern that all views show, plane, and its corners in each (rows, cols, 2) px."""
    first, corners = seen[0], [item.corners for item in seen]
    place = _place_on_sheet(first, known.code_seed)
    whole = all(first.ends) and max(corners[0].shape[:2]) <= MOST_LINES
    if not whole:
        # Corners at the rim of the picture leave it as soon as the gel moves.
        corners = [corners[0][1:-1, 1:-1]]
    code, even = "none", first.even
    if place is not None and whole and not place.shift.any():
        code = "dots"
    elif place is not None:
        start = place.shift + int(not whole)
        part = _middle_of_sheet(start, corners[0].shape[:2])
        if part is not None:
            code, whole = "dots", False
            corners = [item[part] for item in corners]
            even ^= bool((part[0].start + part[1].start) % 2)
    rows, cols = corners[0].shape[:2]
    pattern = parts.Pattern(
        rows,
        cols,
        known.pitch,
        "dark" if even else "light",
        6,
        parts.PatternSurface(),
        code=code,
        code_seed=known.code_seed if code == "dots" else 0,
        border="in_view" if whole else "beyond_view",
    )
    return pattern, corners


def _middle_of_sheet(first: NDArray[np.intp], shape: tuple[int, ...]) -> tuple[slice, slice] | None:
    """Of corners (rows, cols) those around the middle of the largest sheet, as many on each side.

    first (2,): number on the sheet of corner (0, 0).  None where there are too few.
    """
    found = []
    for start, count in zip(first.tolist(), shape, strict=True):
        left_out = max(start, MOST_LINES - start - count)
        found.append(slice(left_out - start, MOST_LINES - left_out - start))
    enough = all(part.stop - part.start >= LEAST_LINES for part in found)
    return (found[0], found[1]) if enough else None


def _centre(size: parts.ImageSize, roi: parts.Roi, layout: str) -> tuple[float, float]:
    """The principal point in px of the view: in the middle of the frame, or of an own camera's."""
    if layout == "cameras":
        return (roi.width - 1) / 2, (roi.height - 1) / 2
    x, y = (size.width - 1) / 2 - roi.x, (size.height - 1) / 2 - roi.y
    return (roi.width - 1 - x if layout == "mirrors" else x), y


@dataclass(frozen=True)
class _Fit:
    """Corners (rows, cols, 2) px as cameras of one kind see them, with their principal points.

    A vector of values: log of the focal length over the usual one, curvature of the surface in
    units of the pattern's half width, first coefficient of distortion, then turn and shift of the
    pattern in each view.
    """

    pattern: parts.Pattern
    corners: Sequence[Float]
    centres: Sequence[tuple[float, float]]
    usual_focal: float

    @property
    def half(self) -> float:
        """Half width of the pattern, m."""
        return (max(self.pattern.rows, self.pattern.cols) - 1) / 2 * self.pattern.pitch

    def best(self, *, fixed: bool) -> tuple[Float, float]:
        """The most probable values, and the corners' root mean square distance, px.

        fixed: the focal length is the usual one.  One view says nothing of surface and distortion.
        """
        start, std = [0.0] * SHARED, [np.log(FOCAL_FACTOR), CURVATURE, DISTORTION]
        for k, seen in enumerate(self.corners):
            known, points = np.isfinite(seen[..., 0]), self.pattern.corners()
            _, turn, shift = cv2.solvePnP(points[known], seen[known], self._matrix(k, 0.0), None)
            start += [*turn[:, 0], *shift[:, 0]]
            std += [TURN_RAD] * 3 + [SHIFT * float(np.linalg.norm(shift))] * 3
        several = len(self.corners) > 1
        free = np.array([not fixed, several, several] + [True] * (len(std) - SHARED))

        def changed(change: Float) -> Float:
            values = np.array(start, dtype=np.float64)
            values[free] += change
            return values

        fit = map_fit(lambda change: self._residuals(changed(change)), np.array(std)[free])
        off = CORNER_PX * np.sqrt(2 * np.mean(fit.residuals**2))
        return changed(fit.values), float(off)

    def _matrix(self, view: int, log_focal: float) -> Float:
        focal = self.usual_focal * float(np.exp(log_focal))
        x, y = self.centres[view]
        return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])

    def _residuals(self, values: Float) -> Float:
        """Corners less where they are expected, in CORNER_PX."""
        points, bend = self.pattern.corners(), values[1] / self.half
        square = (points[..., :2] ** 2).sum(axis=-1)
        with np.errstate(invalid="ignore"):
            points[..., 2] = -bend * square / (1 + np.sqrt(1 - bend**2 * square))
        lens, found = np.array([values[2], 0.0, 0.0, 0.0]), []
        for k, seen in enumerate(self.corners):
            known, matrix = np.isfinite(seen[..., 0]), self._matrix(k, values[0])
            turn, shift = np.split(values[SHARED + 6 * k : SHARED + 6 + 6 * k], 2)
            shown = cv2.projectPoints(points[known], turn, shift, matrix, lens)[0][:, 0]
            found.append((seen[known] - shown) / CORNER_PX)
        return np.asarray(np.concatenate(found).ravel())


def _pose(values: Float) -> Float:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(values[:3]).as_matrix()
    pose[:3, 3] = values[3:]
    return pose


def _described(size: parts.ImageSize, rig: _Rig, name: str) -> SensorDescription:
    views = {
        key: parts.ViewDescription(roi) for key, roi in zip(VIEW_NAMES, rig.rois, strict=False)
    }
    lens = rig.bend, 0.0, 0.0, 0.0, 0.0
    middle = (size.width - 1) / 2, (size.height - 1) / 2
    camera: parts.Camera | None = parts.Camera("pinhole", rig.focal, rig.focal, *middle, lens)
    optics = parts.Optics("monocular", rig.poses[0], ())
    if rig.layout == "mirrors":
        pose, mirrors = mirrors_of(*rig.poses)
        optics = parts.Optics("mirror_stereo", pose, ())
        pairs = zip(views.items(), mirrors, strict=True)
        views = {key: replace(view, mirror=mirror) for (key, view), mirror in pairs}
    elif rig.layout == "cameras":
        optics, camera = parts.Optics("two_view", None, ()), None
        for (key, view), pose in zip(list(views.items()), rig.poses, strict=True):
            x, y = _centre(size, view.roi, rig.layout)
            own = parts.Camera(
                "pinhole", rig.focal, rig.focal, view.roi.x + x, view.roi.y + y, lens
            )
            views[key] = replace(view, camera=own, T_view_gel=pose)
    elastomer = assumed_elastomer(rig.pattern)
    return SensorDescription(name, size, camera, optics, views, rig.pattern, elastomer)


def mirrors_of(left: Float, right: Float) -> tuple[Float, tuple[parts.Mirror, parts.Mirror]]:
    """T_camera_gel (4, 4) and the two mirrors that show these views, T_view_gel (4, 4) each.

    Both mirrors may be turned together about the line where they meet, and the gel with them,
    without a change in the views: they are taken to face the camera.  Raises FrameError where the
    views differ as no two mirrors show.
    """
    seen = [FLIP_X @ pose for pose in (left, right)]
    # The reflection in one mirror, then in the other, turns about that line by twice their angle.
    motion = seen[1] @ np.linalg.inv(seen[0])
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    angle = float(np.linalg.norm(turn))
    if angle < LEAST_TURN_RAD:
        msg = (
            f"picture: found a rotation of {np.degrees(angle):.1f} degrees between the views, "
            "expected more for two mirrors; for two cameras use --views cameras"
        )
        raise FrameError(msg)
    axis = turn / angle
    facing = -np.eye(3)[2] + axis[2] * axis
    facing /= np.linalg.norm(facing)
    on_line = np.linalg.pinv(np.eye(3) - motion[:3, :3]) @ motion[:3, 3]
    mirrors = []
    for share in (-0.25, 0.25):
        normal = Rotation.from_rotvec(share * turn).apply(facing)
        mirrors.append(parts.Mirror(normal, float(normal @ on_line)))
    poses = [reflection(mirror) @ pose for mirror, pose in zip(mirrors, seen, strict=True)]
    pose = poses[0].copy()
    pose[:3, 3] = (poses[0][:3, 3] + poses[1][:3, 3]) / 2
    return pose, (mirrors[0], mirrors[1])
