"""How long tracking takes and how much memory, on the grasp sequence."""

from __future__ import annotations

import gc
import multiprocessing
import resource
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter, process_time, thread_time

import cv2
import numpy as np
from extraction_detectors import Image, classic_corners
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.library import load_sensor
from cmp_tactile_processing.tracking.tracker import GridTracker
from cmp_tactile_simulation.hard_frames.case import PatternFrame

TRACKERS = 20
PASSES = 5
STATM_RESIDENT = 1


@dataclass(frozen=True)
class Speed:
    """Times of a frame, ms, each at its best of PASSES.

    steady: both views on two threads, following; scratch: likewise, each frame anew.  Both tell
    the median and the longest of all frames, and the median of the processor's time for a view.
    scratch_view, classic_view: one view on one thread, from scratch, and OpenCV's classic
    detector with cornerSubPix.  ratio: the median of the frames' ratios of these two.
    followed: share of the steady views that were followed.
    """

    steady: tuple[float, float, float]
    scratch: tuple[float, float, float]
    scratch_view: float
    classic_view: float
    ratio: float
    followed: float


def measure_speed(frames: Sequence[PatternFrame], passes: int = PASSES) -> Speed:
    """Speed on a sequence of one sensor's frames."""
    sensor = frames[0].sensor
    views = list(frames[0].truth)
    images = [_images(frame, views) for frame in frames]
    following = [GridTracker(sensor, view) for view in views]
    anew = replace(sensor, tracking=replace(sensor.tracking, follow=False))
    forgetting = [GridTracker(anew, view) for view in views]
    with ThreadPoolExecutor(len(views)) as pool:
        steady = _both(pool, following, images, 3 * passes)
        followed = [
            tracker.track(image).followed
            for shown in images
            for tracker, image in zip(following, shown, strict=True)
        ]
        scratch = _both(pool, forgetting, images, passes)
    one, peer = _against_classic(sensor, forgetting, images, passes)
    return Speed(
        _summary(steady),
        _summary(scratch),
        float(np.median(one)),
        float(np.median(peer)),
        float(np.median(one / peer)),
        float(np.mean(followed)),
    )


def _images(frame: PatternFrame, views: Sequence[str]) -> list[Image]:
    placements = [frame.truth[view].placement for view in views]
    return [split_frame(frame.image, place) for place in placements if place is not None]


def _summary(times: NDArray[np.float64]) -> tuple[float, float, float]:
    took, used = times
    return float(np.median(took)), float(took.max()), float(np.median(used))


def _both(
    pool: ThreadPoolExecutor,
    trackers: Sequence[GridTracker],
    images: Sequence[Sequence[Image]],
    passes: int,
) -> NDArray[np.float64]:
    """Times (2, frames) ms of tracking all views at once, and the processor's of a view.

    The best of the passes.
    """
    times = np.full((passes + 1, 2, len(images)), np.inf)
    for each in range(passes + 1):
        for number, views in enumerate(images):
            began, used = perf_counter(), process_time()
            jobs = [
                pool.submit(tracker.track, view)
                for tracker, view in zip(trackers, views, strict=True)
            ]
            for job in jobs:
                job.result()
            times[each, 0, number] = 1e3 * (perf_counter() - began)
            times[each, 1, number] = 1e3 * (process_time() - used) / len(views)
    # The first pass is the trackers' warming up.
    return np.asarray(times[1:].min(axis=0))


def _against_classic(
    sensor: SensorDescription,
    trackers: Sequence[GridTracker],
    images: Sequence[Sequence[Image]],
    passes: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times (views,) ms of single views, ours and OpenCV's in turn; the best of the passes."""
    pairs = [pair for views in images for pair in zip(trackers, views, strict=True)]
    times = np.full((passes, 2, len(pairs)), np.inf)
    for each in range(passes):
        for number, (tracker, view) in enumerate(pairs):
            times[each, 0, number] = _ms(lambda t=tracker, v=view: t.track(v))
            times[each, 1, number] = _ms(lambda v=view: classic_corners(sensor, v))
    ours, peer = times.min(axis=0)
    return ours, peer


def _ms(work: Callable[[], object]) -> float:
    """Processor time of this thread: that of other processes does not count."""
    began = thread_time()
    work()
    return 1e3 * (thread_time() - began)


@dataclass(frozen=True)
class Footprint:
    """What a fresh process tells: MB of a tracker, and ms of its first and a later frame."""

    megabytes: float
    first_ms: float
    later_ms: float


def measure_footprint(sensor: str, image: Image, view: str) -> Footprint:
    """In a process of its own: resident memory that twenty trackers add to one, each in use."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        return pool.apply(_footprint, (sensor, image, view))


def _footprint(sensor_name: str, image: Image, view: str) -> Footprint:
    cv2.setNumThreads(1)
    sensor = load_sensor(sensor_name)
    first = GridTracker(sensor, view)
    times = [_ms(lambda: first.track(image)) for _ in range(5)]
    gc.collect()
    before = _resident_bytes()
    trackers = [GridTracker(sensor, view) for _ in range(TRACKERS)]
    for tracker in trackers:
        for _ in range(3):
            tracker.track(image)
    gc.collect()
    added = (_resident_bytes() - before) / TRACKERS
    return Footprint(added / 1e6, times[0], min(times[1:]))


def _resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[STATM_RESIDENT])
    return pages * resource.getpagesize()
