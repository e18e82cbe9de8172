"""No whole frame is called torn, turned, mirrored, blurred, of another size or two patterns.

Reports of the kind, tried here:
mfxox/ILCC 21 (a board parallel to the image's rows is found wrongly, one at 45 degrees is not):
rigs turned by 0 to 90 degrees, two_cameras and flat: 21 of 396 views and more were called torn at
0 to 5 degrees, none now.
opencv/opencv 15712 (wrong corners on a slanted board): the rigs here look from 19 degrees aside and
by mirrors: every corner within 1 px.
"""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from documents import blocks
from tracking.detectors import Ours, view_image

from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_processing.tracking.tracker import GridTracker
from cmp_tactile_simulation.rendering.camera import CameraSettings
from hard_frames.deformation import deformation_of
from hard_frames.studio import PatternCase, PatternStudio

DOCUMENT = Path(__file__).parent.parent / "docs" / "sensor_description.md"
# At rest, pressed and sheared: kind of deformation and seed.
STATES = [("rest", 0), ("press", 1), ("slide", 0), ("slide", 1), ("drag", 1)]
# A misnumbered corner is off by a checker of 8 to 22 px; the tracker is right to 0.1 px.
RIGHT_PX = 1.0


@pytest.fixture(scope="module")
def studio():
    return PatternStudio(samples=2)


@pytest.fixture(scope="module")
def documented(tmp_path_factory):
    """The complete examples of docs/sensor_description.md, by their optics."""
    path = tmp_path_factory.mktemp("documented") / "sensor.yaml"
    rigs = {}
    for text in blocks(DOCUMENT.read_text("utf-8"), "yaml"):
        optics = re.search(r"^  type: (\w+)", text, re.MULTILINE)
        if optics and text.startswith("version"):
            path.write_text(text, "utf-8")
            rigs[optics[1]] = SensorDescription.load(path)
    return rigs


def turned(sensor, degrees):
    """The rig with its cameras turned about their axes: gridlines lie along the images' rows."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    views = {
        name: replace(view, T_view_gel=T @ np.array(view.T_view_gel))
        for name, view in sensor.views.items()
    }
    return replace(sensor, views=views)


def flat(sensor):
    """12 x 16 corners of 1 mm pitch on a flat gel."""
    pattern = replace(sensor.pattern, rows=12, cols=16, pitch=1e-3, surface=PatternSurface())
    return replace(sensor, pattern=pattern)


def assert_whole(studio, sensor, camera):
    """Frame after frame, from scratch and followed: all corners, at the right places."""
    tracker = Ours("following", cold=False)
    for kind, seed in STATES:
        zones = deformation_of(kind, sensor.pattern, seed)
        frame = studio.photograph(PatternCase(kind, sensor, zones, camera, seed=seed))
        for view, truth in frame.truth.items():
            for followed in (False, True):
                grid = tracker.track(sensor, view, view_image(frame, view)).grid
                assert (grid.fault, grid.reason) == (GridFault.NONE, ""), (kind, seed, view)
                error = np.linalg.norm(grid.corners - truth.corners, axis=-1)
                assert error.max() < RIGHT_PX, (kind, seed, view)
                assert followed or not grid.followed
            assert grid.followed, (kind, seed, view)
        tracker.reset()


# Gridlines nearly along the rows are what a tear looks like.
@pytest.mark.parametrize(
    ("surface", "degrees"),
    [("cap", 0), ("cap", 1), ("cap", 45), ("flat", 1), ("flat", 5), ("flat", 90)],
)
def test_two_cameras_turned_about_their_axes(studio, documented, surface, degrees):
    sensor = documented["two_view"]
    sensor = turned(flat(sensor) if surface == "flat" else sensor, degrees)
    assert_whole(studio, sensor, CameraSettings(read_noise=1.0))


@pytest.mark.parametrize("name", ["sample_rig", "prototype", "mirror_stereo", "monocular"])
def test_the_other_rigs(studio, documented, name):
    assert_whole(studio, documented.get(name) or load_sensor(name), CameraSettings())


@pytest.mark.parametrize("shape", ["bars", "plates"])
def test_behind_something_in_pieces_nothing_is_said_of_the_description(studio, shape):
    """What a piece of the pattern shows is no proof that the whole is torn, turned, or smaller."""
    sensor = load_sensor("sample_rig")
    frame = studio.photograph(PatternCase("rest", sensor))
    accused = {}
    for view, truth in frame.truth.items():
        tracker = GridTracker(sensor, view)
        for seed in range(20):
            image = hidden(view_image(frame, view), truth, shape, seed)
            tracker.reset()
            grid = tracker.track(image)
            error = np.linalg.norm(grid.corners - truth.corners, axis=-1)
            assert not (error > RIGHT_PX * 5).any(), (seed, view)
            of_the_description = {GridFault.TURNED, GridFault.MIRRORED, GridFault.OTHER_SIZE}
            if grid.fault in of_the_description or "torn" in grid.reason:
                accused[seed, view] = grid.reason
    # A piece with straight ends on all sides is a smaller pattern for all that one picture shows.
    assert len(accused) <= 1, accused


def hidden(image, truth, shape, seed):
    """The view behind two to five bars or plates, each turned as it comes."""
    rng = np.random.default_rng(seed)
    flat = truth.corners.reshape(-1, 2)
    low, high = flat.min(axis=0), flat.max(axis=0)
    width = float((high - low).max())
    covered = image.copy()
    for _ in range(int(rng.integers(2, 6))):
        centre = rng.uniform(low, high)
        sides = (2.0, rng.uniform(0.06, 0.2)) if shape == "bars" else rng.uniform(0.1, 0.45, 2)
        sides = [width * float(side) for side in sides]
        box = cv2.boxPoints((tuple(map(float, centre)), tuple(sides), float(rng.uniform(0, 180))))
        cv2.fillPoly(covered, [np.rint(box).astype(np.int32)], int(rng.choice([15, 110, 200])))
    return cv2.GaussianBlur(covered, (0, 0), 0.7)
