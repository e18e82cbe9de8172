"""Images of a board: where it is seen, and what is wrong with the images themselves, in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.board.start import Corners
from cmp_tactile_processing.calibration.board.target import (
    BoardSighting,
    BoardTarget,
    chessboard_size,
    find_board,
)
from cmp_tactile_processing.calibration.outcome import finding
from cmp_tactile_processing.errors import Finding
from cmp_tactile_processing.processes import OnProgress

Cut = Callable[[str, NDArray[np.uint8]], NDArray[np.uint8]]

# Different poses of the board: fewer than the first give no result, than the second a warning.
# Simulated mirror rigs are right to 0.01 % with 6 already; plain cameras, and boards that lean
# little, need more.
LEAST_POSES, ENOUGH_POSES = 6, 10
# Of those, seen in both views.
LEAST_SHARED = 4
# Corners that moved less than this between two images, px RMS, show the same pose.
SAME_POSE_PX = 1.0
# Share of the images without a board that is worth a word.
MANY_MISSING = 0.25
# Blur, in sides of a square, that hides the corners, and in blurs of the other images.
BLURRED_SIDES, BLURRED_OTHERS, LEAST_BLUR_PX = 0.14, 2.5, 1.5
# Images without the board that are looked at for another one.
PROBED = 3


@dataclass(frozen=True)
class BoardImages:
    """What is seen in the images of each view; images are counted from 0, None: no board there.

    sizes: width and height by view, px; None where no image could be used.
    other_size: names of images of another size, with it.  other_board: inner corners (cols, rows)
    of another chessboard seen.
    """

    target: BoardTarget
    sightings: dict[str, list[BoardSighting | None]]
    sizes: dict[str, tuple[int, int]]
    other_size: tuple[str, ...] = ()
    other_board: tuple[int, int] | None = None

    @property
    def count(self) -> int:
        """Number of images of a view, that of pairs for two."""
        return max((len(seen) for seen in self.sightings.values()), default=0)

    @property
    def seen(self) -> dict[int, dict[str, BoardSighting]]:
        """Sightings by image and view; images without any are left out."""
        found: dict[int, dict[str, BoardSighting]] = {}
        for view, sightings in self.sightings.items():
            for image, sighting in enumerate(sightings):
                if sighting is not None:
                    found.setdefault(image, {})[view] = sighting
        return dict(sorted(found.items()))


def corners_of(images: BoardImages) -> dict[int, dict[str, Corners]]:
    """Corners by image and view."""
    return {
        image: {view: Corners(item.number, item.pixels) for view, item in views.items()}
        for image, views in images.seen.items()
    }


def look_for_board(
    images: dict[str, Sequence[NDArray[np.uint8]]],
    target: BoardTarget,
    on_progress: OnProgress,
    cut: Cut | None = None,
    size: tuple[int, int] | None = None,
) -> BoardImages:
    """Look for the board in the images of each view.

    images: by view; the same frames for all views where `cut` takes a view's part out of a frame,
    un-mirrored.  size: width and height that images must have, default that of most of a view's.
    """
    total = sum(len(of_view) for of_view in images.values())
    done, sightings, sizes, others = 0, {}, {}, []
    without: list[NDArray[np.uint8]] = []
    for view, of_view in images.items():
        wanted = size or _most_common_size(of_view)
        found: list[BoardSighting | None] = []
        for number, image in enumerate(of_view):
            on_progress("looking for the board", done / total)
            done += 1
            if image.shape[1::-1] != wanted:
                name = f"image {number + 1}" if cut else f"{view} image {number + 1}"
                others.append(f"{name} ({image.shape[1]} x {image.shape[0]})")
                found.append(None)
                continue
            part = cut(view, image) if cut else image
            found.append(find_board(part, target, view))
            if found[-1] is None and len(without) < PROBED:
                without.append(part)
            sizes[view] = part.shape[1], part.shape[0]
        sightings[view] = found
    on_progress("looking for the board", 1.0)
    board = _other_board(target, without) if _few(sightings) else None
    return BoardImages(target, sightings, sizes, tuple(dict.fromkeys(others)), board)


def _most_common_size(images: Sequence[NDArray[np.uint8]]) -> tuple[int, int]:
    return Counter(image.shape[1::-1] for image in images).most_common(1)[0][0]


def _few(sightings: dict[str, list[BoardSighting | None]]) -> bool:
    """Whether a view shows the board in less than half of its images."""
    return any(
        2 * sum(item is not None for item in found) < len(found) for found in sightings.values()
    )


def _other_board(
    target: BoardTarget, images: Sequence[NDArray[np.uint8]]
) -> tuple[int, int] | None:
    """The chessboard of another size that images show most often."""
    sizes = [size for image in images if (size := chessboard_size(image)) is not None]
    own = max(target.cols, target.rows), min(target.cols, target.rows)
    others = Counter(size for size in sizes if size != own)
    return others.most_common(1)[0][0] if others and target.kind == "chessboard" else None


def findings_of_images(images: BoardImages) -> list[Finding]:
    """What is wrong with the images themselves, before anything is fitted."""
    findings = _of_sizes(images) + _of_missing(images)
    seen, repeated = images.seen, _repeated(images)
    distinct = len(seen) - len(repeated)
    if repeated:
        values = {"repeated": len(repeated), "seen": len(seen), "distinct": distinct}
        findings.append(finding("poses repeated", error=distinct < LEAST_POSES, **values))
    findings += _of_count(images, distinct)
    return findings + _of_blur(images)


def _of_sizes(images: BoardImages) -> list[Finding]:
    if not images.other_size:
        return []
    sizes = sorted({f"{width} x {height}" for width, height in images.sizes.values()})
    text = f"Images of another size were left out: {', '.join(images.other_size)}."
    if sizes:
        text = text[:-1] + f"; views are {' and '.join(sizes)} px."
    advice = "Take all images with the same camera, at the resolution that the sensor will use."
    return [Finding.graded(text, advice, error=not images.sizes)]


def _of_missing(images: BoardImages) -> list[Finding]:
    findings = []
    if images.other_board is not None:
        cols, rows = images.other_board
        expected = images.target.cols, images.target.rows
        sides = zip(sorted((cols, rows)), sorted(expected), strict=True)
        whole = "The image must show the whole board, with a white margin. "
        values = {"cols": cols, "rows": rows, "expected": f"{expected[0]} x {expected[1]}"}
        values["whole"] = whole if all(found <= side for found, side in sides) else ""
        return [finding("another board", error=True, **values)]
    for view, sightings in images.sightings.items():
        missing = [number + 1 for number, item in enumerate(sightings) if item is None]
        if len(missing) <= MANY_MISSING * len(sightings):
            continue
        none = len(missing) == len(sightings)
        text = f"The board was not found in {len(missing)} of {len(sightings)} {view} images"
        text += "." if none else f": {_listed(missing)}."
        advice = (
            "The image must show the whole chessboard with a white margin, or most of a ChArUco "
            "board, evenly lit and sharp. Check the number of corners"
        )
        if images.target.kind == "charuco":
            advice += ", the dictionary, and whether the image is mirrored"
        findings.append(Finding.graded(text, advice + ".", error=none))
    return findings


def _of_count(images: BoardImages, distinct: int) -> list[Finding]:
    findings = []
    if distinct < ENOUGH_POSES:
        few = distinct < LEAST_POSES
        values = {"distinct": distinct, "least": LEAST_POSES, "enough": ENOUGH_POSES}
        findings.append(finding("too few poses" if few else "few poses", error=few, **values))
    if len(images.sightings) == 2 and distinct >= LEAST_POSES:
        both = sum(len(views) == 2 for views in images.seen.values())
        if both < LEAST_SHARED:
            values = {"both": both, "least": LEAST_SHARED}
            findings.append(finding("few pairs", error=True, **values))
    return findings


def _of_blur(images: BoardImages) -> list[Finding]:
    blurs = {
        (view, image): (sighting.blur_px, sighting.side_px)
        for image, views in images.seen.items()
        for view, sighting in views.items()
        if np.isfinite(sighting.blur_px)
    }
    if not blurs:
        return []
    usual = float(np.median([blur for blur, _ in blurs.values()]))
    blurred = sorted(
        {
            image + 1
            for (_, image), (blur, side) in blurs.items()
            if blur > LEAST_BLUR_PX and blur > min(BLURRED_SIDES * side, BLURRED_OTHERS * usual)
        }
    )
    if not blurred:
        return []
    return [finding("blurred", error=False, images=_listed(blurred), usual=usual)]


def _repeated(images: BoardImages) -> list[int]:
    """Images that show the board where an earlier one does, in all views."""
    kept: list[dict[str, BoardSighting]] = []
    repeated = []
    for image, views in images.seen.items():
        if any(_same_pose(views, earlier) for earlier in kept):
            repeated.append(image)
        else:
            kept.append(views)
    return repeated


def _same_pose(a: dict[str, BoardSighting], b: dict[str, BoardSighting]) -> bool:
    return a.keys() == b.keys() and all(_moved_px(a[view], b[view]) < SAME_POSE_PX for view in a)


def _moved_px(a: BoardSighting, b: BoardSighting) -> float:
    """RMS way of the corners that both show, px; infinite without any."""
    _, at_a, at_b = np.intersect1d(a.number, b.number, return_indices=True)
    if not len(at_a):
        return float("inf")
    return float(np.sqrt(((a.pixels[at_a] - b.pixels[at_b]) ** 2).sum(axis=1).mean()))


def _listed(numbers: Sequence[int], most: int = 8) -> str:
    listed = ", ".join(str(number) for number in numbers[:most])
    return listed if len(numbers) <= most else f"{listed} and {len(numbers) - most} more"
