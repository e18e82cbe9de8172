"""The written report: pictures that show something, and a page that needs no other file."""

import base64
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO

import numpy as np
import pytest
from matplotlib.collections import QuadMesh
from PIL import Image

from cmp_tactile_bringup.report.demo import (
    contact_figure,
    overview_figure,
    true_states,
    wrench_figure,
    write_report,
)
from cmp_tactile_bringup.report.evaluation import evaluate, table_rows
from cmp_tactile_bringup.report.results import DemoResults
from cmp_tactile_processing.measured import ForceFlag, SlipEstimate, SlipState

FIGURES = ("overview", "wrench", "contacts")
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


def write(results: DemoResults, folder) -> PageReader:
    rows = table_rows(results, evaluate(results))
    return PageReader(write_report(results, rows, folder).read_text())


@pytest.fixture(scope="module")
def page(results, tmp_path_factory):
    return write(results, tmp_path_factory.mktemp("report"))


def test_the_page_holds_all_figures_itself_and_each_shows_something(page):
    assert len(page.sources) == len(FIGURES)
    for source in page.sources:
        kind, _, data = source.partition(";base64,")
        assert kind == "data:image/png"
        picture = Image.open(BytesIO(base64.b64decode(data)))
        grey = np.asarray(picture.convert("L"), np.float64)
        assert min(grey.shape) > 400
        assert grey.std() > 15


def test_the_page_shows_numbers_beside_their_truth(page, results):
    rmse = f"{evaluate(results).corner_rmse_px:.4f} px"
    assert rmse in page.text
    before = max(results.frames, key=lambda frame: -frame.force.wrench[2])
    true = results.recording.truth.wrench[before.index]
    felt, spread = -before.force.wrench[2], 2 * before.force.wrench_std[2]
    assert f"{felt:.2f} ± {spread:.2f} N into the gel (true: {-true[2]:.2f} N)" in page.text
    assert "within ±2 std in" in page.text
    assert "a separate finite-element mesh" in page.text
    assert "Limits missed: Frames lost" in page.text


def test_hidden_markers_unknown_force_and_a_title_of_markup_leave_a_report(results, tmp_path):
    """A third of the markers covered, too few for a force in one frame."""
    frames = [_with_hidden_third(frame) for frame in results.frames]
    frames[1] = replace(frames[1], force=_unknown(frames[1].force))
    recording = replace(results.recording, title="<script>alert(1)</script>")
    changed = replace(results, recording=recording, frames=tuple(frames))
    page = write(changed, tmp_path)
    assert "<script>alert(1)</script>" in page.text


def test_true_and_measured_slip_go_by_one_rule(results):
    """The sensor does not take a rim that slides for slip of the contact."""
    truth = results.recording.truth
    share = results.sensor.slip.incipient_ratio
    states = np.array([1, 2, 3, 3, 4])
    ratio = np.array([np.nan, 0.0, share - 0.01, share + 0.01, 1.0])
    few = {"slip_state": states.astype(np.uint8), "slip_ratio": ratio}
    recording = replace(results.recording, truth=replace(truth, **few))
    assert true_states(replace(results, recording=recording)).tolist() == [1, 2, 2, 3, 4]


def _unknown(force):
    return replace(
        force,
        force=np.full_like(force.force, np.nan),
        contact=np.zeros_like(force.contact),
        wrench=np.full(6, np.nan),
        wrench_covariance=np.full((6, 6), np.nan),
        contact_area=np.nan,
        centre_of_pressure=np.full(3, np.nan),
        contacts=(),
        slip=SlipEstimate(),
        slip_state=SlipState.UNKNOWN,
        flags=ForceFlag.FEW_MARKERS,
    )


def test_forces_that_are_nowhere_known_leave_their_figures(results):
    """NaN in every frame: panels that would be empty are left out."""
    frames = tuple(replace(frame, force=_unknown(frame.force)) for frame in results.frames)
    unknown = replace(results, frames=frames)
    figure = contact_figure(unknown)
    assert [axes.get_ylabel() for axes in figure.axes] == ["area, mm²"]
    assert wrench_figure(unknown).axes
    assert overview_figure(frames[2]).axes
    rows = {row.name: row.value for row in table_rows(unknown, evaluate(unknown))}
    assert rows["Fz error, RMS"].endswith("no error bars")
    assert rows["Flags set, frames"] == f"few_markers in {len(frames)}"
    both = replace(frames[0].force, flags=ForceFlag.AT_BORDER | ForceFlag.FEW_MARKERS)
    flagged = replace(unknown, frames=(replace(frames[0], force=both), *frames[1:]))
    assert evaluate(flagged).force.flagged == {"at_border": 1, "few_markers": len(frames)}


def test_slip_and_friction_are_drawn_beside_their_truth(results):
    """Each that is known has a panel; what is true of it is in the same panel."""
    slip = SlipEstimate(SlipState.INCIPIENT, 0.4, 0.5, 0.62, 0.03)
    frames = tuple(
        replace(frame, force=replace(frame.force, slip=slip, slip_state=slip.state))
        for frame in results.frames
    )
    truth = replace(
        results.recording.truth,
        friction_coefficient=np.full(len(results.recording.truth.stamp_ns), 0.6),
    )
    known = replace(results, frames=frames, recording=replace(results.recording, truth=truth))
    panels = {axes.get_ylabel(): axes for axes in contact_figure(known).axes}
    friction = [line.get_ydata() for line in panels["tangential / normal"].lines]
    assert any(len(y) > len(frames) and np.allclose(y, 0.6) for y in friction), "the truth"
    assert any(len(y) == len(frames) and np.allclose(y, 0.62) for y in friction)


def test_outlines_lie_over_the_pressure_where_the_gel_has_moved_to(results):
    """Of a dragged contact: both moved with the gel."""
    frame = results.frames[2]
    panel = overview_figure(frame).axes[2]
    outline = np.asarray(panel.lines[0].get_xydata()[:-1])
    np.testing.assert_allclose(outline, frame.force.contacts[0].outline[:, :2] * 1e3)
    (mesh,) = [item for item in panel.collections if isinstance(item, QuadMesh)]
    places = mesh.get_coordinates().reshape(-1, 2)
    moved = np.linalg.norm(places - frame.force.position[:, :2] * 1e3, axis=1)
    # The drag of the short grasp, mm, of which the nodes in contact bear the most.
    assert moved.max() > 0.5
    np.testing.assert_allclose(
        places[frame.force.contact].mean(axis=0), outline.mean(axis=0), atol=1.0
    )


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
