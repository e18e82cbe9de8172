"""Bands of light that roll through the frames of a rig leave its forces right.

Public reports of such light: pimoroni/unicorn-hat-hd 43 (PWM of the lamp, no exposure helps),
raspberrypi/libcamera 269 (bands unless the exposure is a multiple of 10 ms).
"""

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.force.advice import UNUSABLE
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_simulation.scenes.description import Hold, MoveBy, Phase, Touch
from cmp_tactile_simulation.scenes.file import load_scene
from hard_frames.contacts import frames_of_ball

REST_FRAMES, CLEARANCE_M, DEPTH_M = 4, 2e-4, 3e-4
# Errors in deviations, at rest and pressed; of a press, N.
AT_REST, PRESSED, PRESSED_N = 3.0, 4.0, 0.02
# Share of the print that is inspected.
JUDGED = 0.99
LOSS, LOSS_TOLERANCE = 0.3, 0.06
# Bands: period and length of an edge, px; way from frame to frame, in periods.
PWM, SLOW, FINE = (90, 12, 0.63), (400, 30, 0.48), (24, 4, 0.63)


@pytest.fixture(scope="module")
def press(sensor):
    """Frames without noise, at rest and pressed, and the forces (n, 3)."""
    images, forces = frames_of_ball(
        sensor,
        Touch((5e-4, -3e-4), CLEARANCE_M),
        Phase("rest", 1, Hold()),
        Phase("close", 3, MoveBy((0.0, 0.0, -CLEARANCE_M - DEPTH_M))),
        Phase("drag", 2, MoveBy((2e-4, 1e-4, 0.0))),
        camera=replace(load_scene("contact_sphere").camera, read_noise=0.0),
    )
    rest = 2 * REST_FRAMES
    return images[:1] * rest + images[-4:], np.concatenate([forces[:1]] * rest + [forces[-4:]])


@pytest.fixture(scope="module")
def pipeline(sensor):
    return Pipeline(sensor)


def lit(images, period, edge, way, loss=LOSS):
    """The images with moving bands, and noise."""
    random = np.random.default_rng(3)
    for k, image in enumerate(images):
        place = (np.arange(len(image)) - way * period * k) % period
        dark = np.clip(place / edge, 0, 1) - np.clip((place - period / 2) / edge, 0, 1)
        grey = image * (1 - loss * dark)[:, None] + random.normal(0, 1, image.shape)
        yield np.rint(grey).clip(0, 255).astype(np.uint8)


def processed(pipeline, frames):
    pipeline.reset()
    pipeline.set_reference(frames[:REST_FRAMES])
    pipeline.reset()
    return [pipeline.process(frame).force for frame in frames]


@pytest.mark.parametrize("bands", [PWM, SLOW], ids=["pwm", "slow"])
def test_bands_are_reported_and_forces_right(bands, press, pipeline):
    images, truth = press
    fields = processed(pipeline, list(lit(images, *bands)))
    for defects in pipeline.print_defects.values():
        assert defects.bands.loss == pytest.approx(LOSS, abs=LOSS_TOLERANCE)
        assert defects.bands.report in defects.report
        assert not defects.defects
    off = np.stack([field.wrench[:3] for field in fields]) - truth
    deviations = np.abs(off) / np.stack([field.wrench_std[:3] for field in fields])
    assert deviations[: 2 * REST_FRAMES].max() < AT_REST
    assert deviations[2 * REST_FRAMES :].max() < PRESSED
    assert not any(field.flags & UNUSABLE for field in fields)
    assert np.abs(off).max() < PRESSED_N


def test_bands_that_move_corners_by_most_of_a_pixel_are_named(press, pipeline):
    """Bands of the width of checkers: it is the light, not the gel, that moves."""
    with pytest.raises(CalibrationError, match="flickers"):
        processed(pipeline, list(lit(press[0], *FINE)))


def test_steady_light_is_not_reported_and_all_is_inspected(press, pipeline):
    images, _ = press
    processed(pipeline, list(lit(images, *PWM, loss=0.0)))
    for defects in pipeline.print_defects.values():
        assert not defects.bands.report
        assert defects.judged > JUDGED
