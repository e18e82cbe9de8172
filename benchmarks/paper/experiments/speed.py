"""V.A: frames per second of each method, alone and with force, on one core."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_bringup.terminal import processor_name
from cmp_tactile_processing.sensor.description import SensorDescription
from paper.chain import Chain, Method
from paper.dot_trackers import ALL_METHODS
from paper.lab import Arrays, Lab, Workplace, mechanics_of, shortened
from paper.page import Page
from paper.sequence import Exposure, RenderedSequence

Points = NDArray[np.float64]

TITLE = "V.A: Speed"
SCENE = "ball:20mm"
# The key of the least that a dot method must do.
PLAIN = "plain_dots"
# Of the plain search: window of the threshold and the least area of a dot, px.
WINDOW, LEAST_AREA = 21, 12

Image = NDArray[np.uint8]


def run(lab: Lab, page: Page) -> None:
    """Time all methods in one process, and report."""
    frames, passes = (5, 2) if lab.fast else (24, 7)
    (data,) = lab.compute(measure_speed, [(SCENE, frames, passes)])
    page.prose("speed", "setup", frames=frames)
    _table(data, page)
    claims(data, page)
    page.departures("speed", processor=processor_name())


def measure_speed(place: Workplace, name: str, frames: int, passes: int) -> dict[str, NDArray[Any]]:
    """Processor times of a frame at its best of the passes.

    KEY_extraction, KEY_chain (frames,) ms: both views tracked; the whole chain with force.  In
    every pass each frame is given to all methods, one after another.  PLAIN has extraction alone;
    plain_found: dots that it finds in a view.
    """
    scene = shortened(name, {"rest": 1, "press": frames}, fast=place.fast)
    mechanics = mechanics_of(scene, place)
    pressed = mechanics.frames("press")
    surfaces = [mechanics.surface(int(k), scene.sensor.pattern) for k in pressed]
    shown = {
        kind: RenderedSequence(scene.sensor, surfaces, kind).exposed(0) for kind in ("cmp", "dmp")
    }
    clocked = {
        method.key: _Clocked(scene.sensor, method, shown[method.pattern_type])
        for method in ALL_METHODS
    }
    names = [f"{key}_{what}" for key in clocked for what in ("extraction", "chain")]
    times = {name: np.full((passes, frames), np.inf) for name in (*names, f"{PLAIN}_extraction")}
    plain = clocked["dmp_nearest"]
    for each in range(passes):
        for one in clocked.values():
            one.reset()
        for frame in range(frames):
            for key, one in clocked.items():
                times[f"{key}_extraction"][each, frame] = one.extraction_ms(frame)
                times[f"{key}_chain"][each, frame] = one.chain_ms(frame)
            times[f"{PLAIN}_extraction"][each, frame] = plain.plain_ms(frame)
    least = {name: values.min(axis=0) for name, values in times.items()}
    return {**least, "plain_found": np.array(plain.plain_found)}


def median_ms(times: Points) -> float:
    """Of a frame."""
    return float(np.median(times))


def find_plainly(view: Image, earlier: Points) -> Points:
    """Centres of dark dots (n, 2) px in the order of the nearest earlier ones, (n, 2) px or none.

    The least that section II.A asks for: a threshold, centres of what is connected, and for each
    the nearest of the frame before; no care for light, blur, refraction or numbers.
    """
    mode, kind = cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV
    dark = cv2.adaptiveThreshold(view, 255, mode, kind, WINDOW, 10)
    _, _, facts, centres = cv2.connectedComponentsWithStats(dark)
    found: Points = np.asarray(centres[1:][facts[1:, cv2.CC_STAT_AREA] >= LEAST_AREA], np.float64)
    if not len(earlier) or not len(found):
        return found
    nearest = cKDTree(found).query(earlier)[1]
    return np.asarray(found[nearest])


class _Clocked:
    """Times the tracker of a method and its whole chain, each in a chain that follows by itself."""

    def __init__(self, sensor: SensorDescription, method: Method, shown: Exposure) -> None:
        self._frames = shown.frames
        self._tracking, self._chain = (
            Chain(sensor, method, with_force=with_force) for with_force in (False, True)
        )
        for chain in (self._tracking, self._chain):
            chain.set_reference(shown.rest)
        self._plain = {name: np.empty((0, 2)) for name in sensor.views}
        self._find_plainly(shown.rest[0])
        self.plain_found = [len(found) for found in self._plain.values()]

    def reset(self) -> None:
        """Begin with the first frame again."""
        self._tracking.reset()
        self._chain.reset()

    def plain_ms(self, frame: int) -> float:
        """Both views cut out and their dots found plainly."""
        return _ms(lambda: self._find_plainly(self._frames[frame]))

    def extraction_ms(self, frame: int) -> float:
        """Both views cut out and tracked."""
        return _ms(lambda: self._tracking.track(self._frames[frame]))

    def chain_ms(self, frame: int) -> float:
        """From the frame to the force."""
        return _ms(lambda: self._chain.measure(self._frames[frame]))

    def _find_plainly(self, image: Image) -> None:
        for name, view in self._tracking.views(image).items():
            self._plain[name] = find_plainly(view, self._plain[name])


def _ms(work: Callable[[], object]) -> float:
    """Processor time of this thread: that of other processes does not count."""
    began = time.thread_time()
    work()
    return 1e3 * (time.thread_time() - began)


# The paper's, Hz; what it includes is not stated.
PAPER_CMP, PAPER_DMP = 18.0, 24.0


def _table(data: Arrays, page: Page) -> None:
    rows = [
        (m.label, *_rates(data[f"{m.key}_extraction"]), *_rates(data[f"{m.key}_chain"]))
        for m in ALL_METHODS
    ]
    plain = *_rates(data[f"{PLAIN}_extraction"]), *_rates(_plain_chain(data))
    page.table("speed.rates", (*rows, ("dots, at the least", *plain)))


def _rates(times: Points) -> tuple[str, str]:
    ms = median_ms(times)
    return f"{ms:.1f} ms", f"{1e3 / ms:.0f}"


def _plain_chain(data: Arrays) -> Points:
    rest = median_ms(data["cmp_chain"] - data["cmp_extraction"])
    return np.asarray(data[f"{PLAIN}_extraction"] + rest)


def claims(data: Arrays, page: Page) -> None:
    """Compare the paper's rates with ours."""
    ours, plain = median_ms(data["cmp_chain"]), median_ms(_plain_chain(data))
    rate, nearest = 1e3 / ours, median_ms(data["dmp_nearest_chain"])
    page.claim("speed.rate", rate >= PAPER_CMP, rate=rate, processor=processor_name())
    enough = plain / ours >= PAPER_CMP / PAPER_DMP
    page.claim("speed.ratio", enough, plain=plain / ours, nearest=nearest / ours)
