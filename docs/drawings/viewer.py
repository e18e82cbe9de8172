"""Takes the pictures of docs/viewer.md and docs/grasp.md: the page in a headless Chromium.

Run it in the environment of the repository, with Debian's package chromium installed:
`setup/run python3 docs/drawings/viewer.py`
The scene `grasp` is simulated where it is not in the cache.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image
from playwright.sync_api import Page as Tab
from playwright.sync_api import sync_playwright

from cmp_tactile_bringup.recordings.library import required_sensors
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing import Pipeline, SensorDescription
from cmp_tactile_processing.errors import Finding, Severity
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.grasp.play import Grasp
from cmp_tactile_simulation.grasp.record import record_grasp
from cmp_tactile_simulation.grasp.scene import load_grasp
from cmp_tactile_simulation.recording.run import recording_of
from cmp_tactile_viewer.page.page import Page
from cmp_tactile_viewer.page.server import Access
from cmp_tactile_viewer.recording import open_source, snapshot_health
from cmp_tactile_viewer.snapshot import (
    PassiveSource,
    Pose,
    ShownSensor,
    Snapshot,
)

OUTPUT = Path(__file__).parents[1] / "images"
SCENE = "grasp"
SIZE = {"width": 1440, "height": 900}
# Without a graphics card.
OPTIONS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
# The frame in which the bar is pressed and dragged, and those before it that the plots show.
CONTACT = 28
# Fingers of a gripper: 40 mm apart, gels face to face.
HALF_WAY_M = 0.02
TO_THE_RIGHT = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
TO_THE_LEFT = (np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0)
# Of the packaged grasp `box`: while it is tilted.
HELD_S = 2.0
# What covers the left view of the picture of a fault, px, and its grey.
COVER, COVER_GREY = (slice(200, 420), slice(60, 260)), 70
TIMEOUT_MS = 60_000
QUALITY = 88
# The moving picture: px, time of a picture in it, and what the page needs to draw one.
FILM_SIZE, FILM_STEP_MS, FILM_QUALITY = (960, 600), 120, 60
SETTLED_MS = 700


def main() -> int:
    """Take all pictures."""
    bag = recording_of(SCENE)
    sensor = SensorDescription.load(bag / "sensor.yaml")
    pipeline = Pipeline(sensor)
    shown = []
    for frame in BagReader(bag).frames():
        done = pipeline.process(frame.image, frame.stamp_ns)
        stamp, image = frame.stamp_ns, frame.image
        shown.append(Snapshot(stamp, image, done.left, done.right, done.surface, done.force))
    covered = shown[CONTACT].frame.copy()
    covered[COVER] = COVER_GREY
    stamp = shown[CONTACT].stamp_ns
    done = pipeline.process(covered, stamp)
    fault = Snapshot(stamp, covered, done.left, done.right, done.surface, done.force)
    with _tab() as tab:
        one = (ShownSensor("sample_rig", sensor),)
        _take(tab, one, [shown[: CONTACT + 1]], "viewer_contact")
        _take(tab, one, [[*shown[:CONTACT], fault]], "viewer_fault")
        two = (
            ShownSensor("left_finger", sensor, Pose((-HALF_WAY_M, 0.0, 0.0), TO_THE_RIGHT)),
            ShownSensor("right_finger", sensor, Pose((HALF_WAY_M, 0.0, 0.0), TO_THE_LEFT)),
        )
        _take(tab, two, [shown[: CONTACT + 1]] * 2, "viewer_fingers")
        _take(tab, one, [shown], "viewer_plots", clip=(0, 0, 400, 720))
        _film(tab, one[0], shown[::2], "viewer_grasp")
        _take_held(tab)
    return 0


@contextmanager
def _tab() -> Iterator[Tab]:
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    if browser is None:
        sys.exit("found no chromium: apt install chromium")
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=browser, args=OPTIONS)
        yield launched.new_page(viewport=SIZE)
        launched.close()


def _take(
    tab: Tab,
    sensors: tuple[ShownSensor, ...],
    snapshots: Sequence[Sequence[Snapshot]],
    name: str,
    clip: tuple[int, int, int, int] | None = None,
) -> None:
    """Show one snapshot after another of each sensor, and take a picture of the last."""
    with _opened(tab, sensors, snapshots):
        box = dict(zip(("x", "y", "width", "height"), clip, strict=True)) if clip else None
        picture = Image.open(BytesIO(tab.screenshot(clip=box))).convert("RGB")
    picture.save(OUTPUT / f"{name}.webp", quality=QUALITY)


def _take_held(tab: Tab) -> None:
    """Both fingers of a grasp with what they hold."""
    with TemporaryDirectory() as folder:
        bag = Path(folder) / "box"
        record_grasp(Grasp(load_grasp("box")), bag, lambda _: None)
        source = open_source(bag, *map(load_sensor, required_sensors(bag)))
        shown: dict[str, list[Snapshot]] = {sensor.name: [] for sensor in source.sensors}
        for time_s, moment in source.frames.read(0.0):
            for name, snapshot in moment.items():
                shown[name].append(source.scene.placed(name, snapshot))
            if time_s >= HELD_S:
                break
        source.close()
    _take(tab, source.sensors, [*shown.values()], "grasp_view")


def _film(tab: Tab, sensor: ShownSensor, snapshots: Sequence[Snapshot], name: str) -> None:
    """A moving picture of the page while one snapshot after another is shown."""
    pictures = []
    with _opened(tab, (sensor,), [snapshots[:1]]) as page:
        # The first is there already.
        for snapshot in snapshots[1:]:
            drawn = page.pictures
            page.show(sensor.name, snapshot)
            while page.pictures <= drawn:
                tab.wait_for_timeout(50)
            tab.wait_for_timeout(SETTLED_MS)
            picture = Image.open(BytesIO(tab.screenshot())).convert("RGB")
            pictures.append(picture.resize(FILM_SIZE, Image.Resampling.LANCZOS))
    pictures[0].save(
        OUTPUT / f"{name}.webp",
        save_all=True,
        append_images=pictures[1:],
        duration=FILM_STEP_MS,
        loop=0,
        quality=FILM_QUALITY,
        method=6,
    )


@contextmanager
def _opened(
    tab: Tab, sensors: tuple[ShownSensor, ...], snapshots: Sequence[Sequence[Snapshot]]
) -> Iterator[Page]:
    """The page with these snapshots, drawn in the tab."""
    source = PassiveSource(sensors)
    with Page(source, Access(port=None)) as page:
        for sensor, items in zip(sensors, snapshots, strict=True):
            for item in items:
                page.show(sensor.name, item)
        lines = [
            replace(line, about=f"{sensor.name}, {line.about}")
            for sensor, items in zip(sensors, snapshots, strict=True)
            for line in snapshot_health(items[-1])
        ]
        page.show_health(lines or [Finding(Severity.OK, "markers as expected", about="all")])
        tab.goto(page.url)
        tab.get_by_text("Software WebGL").wait_for(timeout=TIMEOUT_MS)
        tab.locator(".mantine-Notification-closeButton").click()
        tab.get_by_text("Software WebGL").wait_for(state="hidden", timeout=TIMEOUT_MS)
        drawn = page.pictures
        while page.pictures < max(drawn, len(sensors)):
            tab.wait_for_timeout(100)
        tab.wait_for_timeout(3000)
        yield page


if __name__ == "__main__":
    sys.exit(main())
