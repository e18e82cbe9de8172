"""The gel at rest as a gauge: descriptions wrong by a known amount, and gels that are touched."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import Grid, Markers3D, ReferenceFault
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import RefractingLayer, Uncertainty
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.surface.gauge import GaugeReading, RestGauge
from cmp_tactile_processing.surface.reference_keeping import ReferenceKeeper
from cmp_tactile_processing.surface.stillness import RestParameters

# Noise of a mean corner, px.
NOISE_PX = 0.003
# What a touch makes of the shape: `rest_tolerance`, m.
TOUCH_M = RestParameters().rest_tolerance
# Displacement by which gains are measured, m: 2000 times the noise.
STEP_M = 50e-6
# Of a gain: its sampled mean square over 16 corners against that over all 400.
SAMPLING = 0.25
# Standard deviations of several gains, each of one draw and so with its own luck.
LUCK = 3.0

Change = Callable[[SensorDescription, float], SensorDescription]


def _focal(sensor: SensorDescription, error: float) -> SensorDescription:
    camera = sensor.camera
    return replace(
        sensor, camera=replace(camera, fx=camera.fx * (1 + error), fy=camera.fy * (1 + error))
    )


def _centre(sensor: SensorDescription, error: float) -> SensorDescription:
    return replace(sensor, camera=replace(sensor.camera, cx=sensor.camera.cx + error))


def _pitch(sensor: SensorDescription, error: float) -> SensorDescription:
    return replace(
        sensor, pattern=replace(sensor.pattern, pitch=sensor.pattern.pitch * (1 + error))
    )


def _radius(sensor: SensorDescription, error: float) -> SensorDescription:
    surface = sensor.pattern.surface
    surface = replace(surface, radius=surface.radius * (1 + error))
    return replace(sensor, pattern=replace(sensor.pattern, surface=surface))


def _glass(sensor: SensorDescription, index: float) -> SensorDescription:
    layers = (RefractingLayer(-0.006, index),)
    return replace(sensor, optics=replace(sensor.optics, layers=layers))


def _moved(sensor: SensorDescription, shift: float) -> SensorDescription:
    pose = sensor.optics.T_camera_gel.copy()
    pose[:3, 3] += pose[:3, :3] @ [shift, -shift, shift]
    return replace(sensor, optics=replace(sensor.optics, T_camera_gel=pose))


def _pixels(
    sensor: SensorDescription, moved: NDArray[np.float64] | float = 0.0, noise: float = NOISE_PX
) -> dict[str, NDArray[np.float64]]:
    """Where the views of the true sensor see its corners, displaced by so much."""
    random = np.random.default_rng(5)
    corners = sensor.pattern.corners() + moved
    shape = (*corners.shape[:2], 2)
    return {
        name: view.project(corners) + random.normal(0.0, noise, shape)
        for name, view in build_views(sensor).items()
    }


def _markers(sensor: SensorDescription, pixels: Mapping[str, NDArray[np.float64]]) -> Markers3D:
    wide = replace(sensor.triangulation, max_ray_gap=1e-2)
    empty = Grid.missing(sensor.pattern.shape, "")
    grids = {
        name: replace(empty, corners=q, corner_status=np.ones(q.shape[:2], np.uint8))
        for name, q in pixels.items()
    }
    rig = StereoRig(replace(sensor, triangulation=wide))
    return rig.triangulate(grids.get("left"), grids.get("right"))


def _gain(true: SensorDescription, described: SensorDescription) -> NDArray[np.float64]:
    """RMS over the corners of measured over true displacement, less 1, (3, 3)."""
    at_rest = _markers(described, _pixels(true, noise=0.0)).position
    columns = [
        _markers(described, _pixels(true, STEP_M * axis, noise=0.0)).position - at_rest
        for axis in np.eye(3)
    ]
    return np.sqrt(np.mean((np.stack(columns, axis=-1) / STEP_M - np.eye(3)) ** 2, axis=(0, 1)))


def _read(true: SensorDescription, described: SensorDescription) -> GaugeReading:
    reading = RestGauge(described).read(_pixels(true))
    assert reading is not None
    return reading


@pytest.mark.parametrize(
    ("change", "error", "named"),
    [
        (_focal, 0.03, "focal length -2.9%"),
        (_focal, -0.012, "focal length +1.2%"),
        (_pitch, 0.024, "pattern.pitch -2.4%"),
        (_centre, 10.0, "camera.cx -10"),
    ],
)
def test_a_wrong_description_is_found_and_named_with_what_it_does(
    sensor: SensorDescription, change: Change, error: float, named: str
) -> None:
    described = change(sensor, error)
    reading = _read(sensor, described)
    assert named in reading.doubt
    gain = np.sqrt(np.diag(reading.systematics.bias)[:9]).reshape(3, 3)
    expected = _gain(sensor, described)
    if change is _pitch:
        # Images cannot tell a larger print from a larger rig: the rig is off by as much.
        expected = abs(error) * np.eye(3)
    np.testing.assert_allclose(gain, expected, atol=SAMPLING * expected.max())


@pytest.mark.parametrize(("error", "is_doubted"), [(0.014, False), (0.026, True)])
def test_two_per_cent_of_an_error_are_doubted(
    sensor: SensorDescription, error: float, is_doubted: bool
) -> None:
    known = replace(sensor, uncertainty=Uncertainty({"pattern.pitch": 5e-3, "camera.fx": 1e-4}))
    assert bool(_read(sensor, _pitch(known, error)).doubt) == is_doubted


def test_a_layer_that_was_not_described_is_found(sensor: SensorDescription) -> None:
    reading = _read(_glass(sensor, 1.45), sensor)
    assert "index of refraction" in reading.doubt
    assert reading.bump < TOUCH_M
    # A quarter of the depth: the displacement along z is measured too small by so much.
    assert 0.1 < np.sqrt(reading.systematics.bias[8, 8]) < 0.3


@pytest.mark.parametrize("change", [_moved, None])
def test_a_right_description_is_not_doubted_wherever_the_gel_sits(
    sensor: SensorDescription, change: Change | None
) -> None:
    reading = _read(sensor, change(sensor, 3e-4) if change else sensor)
    assert reading.doubt == ""
    assert reading.bump < TOUCH_M / 4
    spread = np.sqrt(np.diag(reading.systematics.spread))
    # What is not seen stays open: the pitch, and with it all distances.
    assert spread[9] == pytest.approx(0.005, rel=0.05)
    assert (np.sqrt(np.diag(reading.systematics.bias)) < LUCK * spread + 1e-3).all()


def test_another_radius_is_no_error_of_displacements(sensor: SensorDescription) -> None:
    reading = _read(sensor, _radius(sensor, 0.6))
    assert "pattern.surface" in reading.explanation
    gain = np.sqrt(np.diag(reading.systematics.bias)[:9:4])
    assert (gain < 0.01).all()


def test_what_the_fit_leaves_open_holds_the_truth(sensor: SensorDescription) -> None:
    # Monte Carlo: rigs and prints that differ from the description as its priors say.
    random, z = np.random.default_rng(11), []
    for _ in range(12):
        true = _focal(_centre(_pitch(sensor, random.normal(0, 5e-3)), random.normal(0, 5)),
                      random.normal(0, 0.02))  # fmt: skip
        reading, truth = _read(true, sensor), _gain(true, sensor)
        total = np.sqrt(np.diag(reading.systematics.total))
        # The force of a normal press follows depth and pattern.
        z.append(truth[2, 2] / np.hypot(total[8], total[9]))
    assert np.sqrt(np.mean(np.square(z))) < 1.5
    assert max(z) < LUCK


def test_stated_deviations_replace_the_usual_ones(sensor: SensorDescription) -> None:
    exact = {"pattern.pitch": 1e-5, "camera.fx": 1e-5, "camera.distortion[0]": 1e-6}
    known = _read(sensor, replace(sensor, uncertainty=Uncertainty(exact)))
    usual = _read(sensor, sensor)
    assert known.systematics.spread[9, 9] < 1e-9
    assert known.systematics.spread[8, 8] < usual.systematics.spread[8, 8]


def _dent(sensor: SensorDescription, depth: float) -> NDArray[np.float64]:
    corners = sensor.pattern.corners()
    bell = np.exp(-((corners[..., 0] - 2e-3) ** 2 + corners[..., 1] ** 2) / (2e-3) ** 2)
    return np.stack([0 * bell, 0 * bell, -depth * bell], axis=-1)


@pytest.mark.parametrize(
    ("described", "dent", "faults"),
    [
        (lambda sensor: sensor, 0.0, ReferenceFault.NONE),
        (lambda sensor: sensor, 100e-6, ReferenceFault.TOUCHED),
        (lambda sensor: _focal(sensor, 0.03), 0.0, ReferenceFault.DESCRIPTION),
    ],
)
def test_a_reference_says_whether_the_gel_is_touched_or_described_wrongly(
    sensor: SensorDescription,
    described: Callable[[SensorDescription], SensorDescription],
    dent: float,
    faults: ReferenceFault,
) -> None:
    wrong = described(sensor)
    keeper = ReferenceKeeper(Reference.nominal(wrong), RestGauge(wrong))
    said = keeper.take([_markers(wrong, _pixels(sensor, _dent(sensor, dent)))], stamp_ns=1)
    assert keeper.reference.faults == faults
    assert ("; but " in said) == bool(faults)
    assert keeper.reference.systematics is not None


def test_too_few_corners_show_nothing(sensor: SensorDescription) -> None:
    pixels = _pixels(sensor)
    pixels["left"][:12] = np.nan
    assert RestGauge(sensor).read(pixels) is None


def test_hidden_corners_are_left_out(sensor: SensorDescription) -> None:
    pixels = _pixels(sensor)
    pixels["left"][:5], pixels["right"][:, 15:] = np.nan, np.nan
    reading = RestGauge(sensor).read(pixels)
    assert reading is not None
    assert reading.doubt == ""
    assert np.isfinite(reading.systematics.total).all()


def test_one_view_is_gauged_in_its_plane(sensor: SensorDescription) -> None:
    optics = replace(sensor.optics, type="monocular")
    one = replace(sensor, optics=optics, views={"left": sensor.views["left"]})
    reading = _read(one, _pitch(one, 0.03))
    # It may be the print or how far the gel is away: in the plane both come to the same.
    assert "about 3%" in reading.doubt
    assert reading.systematics.total[8, 8] == 0.0
