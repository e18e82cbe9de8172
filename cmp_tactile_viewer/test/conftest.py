"""A grasp that was processed once, pages that it is shown on, and a browser."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from browser_tab import Tab

from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_viewer.page.page import Page
from cmp_tactile_viewer.page.server import Access
from cmp_tactile_viewer.snapshot import PassiveSource, ShownSensor, Snapshot, Source

# Of the 20 frames of the recording, the first is at rest.
IN_CONTACT = 9
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# Without a graphics card.
OPTIONS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@pytest.fixture(scope="session")
def sensor(grasp_bag: Path) -> SensorDescription:
    return SensorDescription.load(grasp_bag / "sensor.yaml")


@pytest.fixture(scope="session")
def snapshots(grasp_bag: Path, sensor: SensorDescription) -> list[Snapshot]:
    """Of the frames up to the contact."""
    pipeline, found = Pipeline(sensor), []
    for _, frame in zip(range(IN_CONTACT + 1), BagReader(grasp_bag).frames(), strict=False):
        done = pipeline.process(frame.image, frame.stamp_ns)
        found.append(
            Snapshot(
                frame.stamp_ns, frame.image, done.left, done.right, done.surface, done.force, 0.02
            )
        )
    assert found[-1].force is not None
    assert found[-1].force.contacts
    return found


@pytest.fixture
def serve() -> Iterator[Callable[..., Page]]:
    """Serves a source on a free port until the test ends."""
    pages: list[Page] = []

    def served(source: Source, **access: Any) -> Page:
        pages.append(Page(source, Access(**{"port": None, **access})))
        return pages[-1]

    yield served
    for page in pages:
        page.close()


@pytest.fixture
def source(sensor: SensorDescription) -> PassiveSource:
    return PassiveSource((ShownSensor("thumb", sensor),))


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A headless Chromium of the system."""
    playwright = pytest.importorskip("playwright.sync_api")
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"found none of {', '.join(BROWSERS)}")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=list(OPTIONS))
        yield browser
        browser.close()


@pytest.fixture
def opened(chromium: Any) -> Iterator[Callable[..., Tab]]:
    """Opens pages, each in a tab, until the test ends."""
    tabs: list[Tab] = []

    def open_(page: Page, size: Any = None) -> Tab:
        tabs.append(Tab(chromium, page, size))
        return tabs[-1]

    yield open_
    for tab in tabs:
        tab.tab.close()
