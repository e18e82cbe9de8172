"""The written report: pictures that show something, and a page that needs no other file."""

from __future__ import annotations

import base64
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from cmp_tactile_bringup.report.evaluation import evaluate, table_rows
from cmp_tactile_bringup.report.results import DemoResults
from cmp_tactile_bringup.report.write import report_steps, write_report

FIGURES = (
    "frame.png", "displacement.png", "shape.png", "knock.png", "force.png", "wrench.png",
)  # fmt: skip
VOID = {"meta", "img"}


class PageReader(HTMLParser):
    """Text and picture sources of a page; fails on tags that do not match."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.text = ""
        self._open: list[str] = []
        self.feed(html)
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        if tag == "img":
            self.sources.append(dict(attrs)["src"])
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text += data


def write(results: DemoResults, folder, on_step=lambda: None) -> PageReader:
    rows = table_rows(results, evaluate(results))
    return PageReader(write_report(results, rows, folder, on_step).read_text())


@pytest.fixture(scope="module")
def page_and_folder(results, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    steps: list[None] = []
    page = write(results, folder, lambda: steps.append(None))
    assert len(steps) == report_steps(results)
    return page, folder


def test_every_figure_is_a_picture_with_content(page_and_folder):
    _, folder = page_and_folder
    for name in (*FIGURES, "overview.png"):
        with Image.open(folder / name) as picture:
            grey = np.asarray(picture.convert("L"), np.float64)
        assert min(grey.shape) > 400, name
        assert grey.std() > 15, name


def test_the_animation_has_one_picture_per_frame(page_and_folder, results):
    _, folder = page_and_folder
    with Image.open(folder / "grasp.webp") as picture:
        assert picture.n_frames == len(results.frames)


def test_the_page_holds_all_pictures_itself(page_and_folder):
    page, _ = page_and_folder
    assert len(page.sources) == len(FIGURES) + 1
    for source in page.sources:
        kind, _, data = source.partition(";base64,")
        assert kind in ("data:image/png", "data:image/webp")
        Image.open(BytesIO(base64.b64decode(data))).verify()


def test_the_page_tells_numbers_beside_their_truth(page_and_folder, results):
    page, _ = page_and_folder
    rmse = f"{evaluate(results).corner_rmse_px:.4f} px"
    assert rmse in page.text
    before = results.frames[2]
    true = results.recording.truth.wrench[before.index]
    assert f"{-before.force.wrench[2]:.2f} N into the gel, truly {-true[2]:.2f} N" in page.text
    assert "finite-element mesh of its own" in page.text
    assert "Limits missed: Frames lost" in page.text
    assert "2.2 checkers" in page.text


@pytest.fixture(scope="module")
def page_of_trouble(results, tmp_path_factory):
    """A third of the markers covered, too few for a force in one frame, and a title of markup."""
    frames = [_with_hidden_third(frame) for frame in results.frames]
    force = frames[1].force
    unknown = replace(
        force,
        force=np.full_like(force.force, np.nan),
        contact=np.zeros_like(force.contact),
        wrench=np.full(6, np.nan),
        centre_of_pressure=np.full(3, np.nan),
    )
    frames[1] = replace(frames[1], force=unknown)
    recording = replace(results.recording, title="<script>alert(1)</script>")
    changed = replace(results, recording=recording, frames=tuple(frames))
    return write(changed, tmp_path_factory.mktemp("trouble"))


def test_text_of_a_recording_is_text_on_the_page(page_of_trouble):
    assert "<script>alert(1)</script>" in page_of_trouble.text


def test_hidden_markers_and_unknown_force_leave_a_report(page_of_trouble):
    assert "260 of 400 markers" in page_of_trouble.text


def _with_hidden_third(frame):
    surface = frame.surface
    position, moved = surface.position.copy(), surface.displacement.copy()
    position[:7] = moved[:7] = np.nan
    status = surface.status.copy()
    status[:7] = 0
    corners = frame.left.corners.copy()
    corners[:7] = np.nan
    hidden = replace(surface, position=position, displacement=moved, status=status)
    return replace(frame, surface=hidden, left=replace(frame.left, corners=corners))
