"""A gel with the print that is made by default is never seen mirrored or turned without a word.

Public reports of what plain boards and markers do: opencv_contrib 2669 (a mirrored marker is just
not found), ros-perception/ar_track_alvar 32 (a mirrored marker is another one, its axis reversed),
mikeferguson/robot_calibration 139 (a board turned by half looks the same).
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from command_output import printed, run

from cmp_tactile_processing.force.advice import UNUSABLE
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import Checkerboard
from cmp_tactile_simulation.rendering.renderer import Renderer
from cmp_tactile_simulation.rendering.surface import DeformedSurface


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The description that the default print comes with."""
    path = tmp_path_factory.mktemp("print") / "rig"
    assert run("pattern", "sample_rig", "--format", "svg", "-o", path) == 0
    return path.with_suffix(".yaml")


def photograph(sensor):
    surface = DeformedSurface.rest(sensor.pattern)
    rendered = Renderer(sensor, Checkerboard(sensor.pattern)).render(surface)
    return expose(rendered, CameraSettings(), np.random.default_rng(0))


@pytest.fixture(scope="module")
def frame(written):
    return photograph(load_sensor(str(written)))


@pytest.fixture(scope="module")
def pipeline(written):
    return Pipeline(load_sensor(str(written)))


def in_each_view(change):
    """Of both halves of a frame."""
    return lambda frame: np.hstack([change(half) for half in np.hsplit(frame, 2)])


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (np.fliplr, GridFault.MIRRORED),
        (np.flipud, GridFault.MIRRORED),
        (in_each_view(np.fliplr), GridFault.MIRRORED),
        (lambda frame: np.rot90(frame, 2), GridFault.TURNED),
        (in_each_view(lambda view: np.rot90(view, 2)), GridFault.TURNED),
    ],
    ids=["mirrored", "upside down", "each view mirrored", "turned", "each view turned"],
)
def test_a_wrong_view_of_the_print_is_named_and_gives_no_force(change, fault, frame, pipeline):
    pipeline.reset()
    result = pipeline.process(np.ascontiguousarray(change(frame)))
    assert {result.left.fault, result.right.fault} == {fault}
    assert np.isnan(result.force.wrench).all()
    assert result.force.flags & UNUSABLE


def test_the_right_view_is_complete(frame, pipeline):
    pipeline.reset()
    result = pipeline.process(frame)
    assert (result.left.found_fraction, result.right.found_fraction) == (1, 1)
    assert not pipeline.pattern_doubt


def test_dots_that_are_not_described_are_named(frame, tmp_path, capsys):
    cv2.imwrite(str(tmp_path / "frame.png"), frame)
    command = "process", tmp_path / "frame.png", "--sensor", "sample_rig", "--output", tmp_path
    assert run(*command) == 0
    assert "pattern.code is none" in printed(capsys)


def test_described_dots_that_are_not_there_are_named(written, pipeline):
    sensor = load_sensor(str(written))
    plain = replace(sensor, pattern=replace(sensor.pattern, code="none"))
    pipeline.reset()
    result = pipeline.process(photograph(plain))
    assert {result.left.fault, result.right.fault} == {GridFault.OTHER_PATTERN}
    assert np.isnan(result.force.wrench).all()
