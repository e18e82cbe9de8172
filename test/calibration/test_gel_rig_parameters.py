"""Optical values as a vector, and rigs that were changed by a known amount."""

from dataclasses import replace

import numpy as np
from calibration_rigs import one_view_rig, two_view_rig

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rig_parameters import RigParameters, RigPrior
from cmp_tactile_processing.sensor.description import SensorDescription, write_sensor_description
from cmp_tactile_processing.sensor.parts import RefractingLayer

EVERYTHING = RigPrior(aspect=1e-3, distortion=1e-3, layer_z=1e-5, layer_index=1e-3)


def with_layers(sensor):
    layers = (RefractingLayer(-0.009, 1.49), RefractingLayer(-0.006, 1.41))
    return replace(sensor, optics=replace(sensor.optics, layers=layers))


def pixels(sensor):
    corners = sensor.pattern.corners()
    return np.stack([view.project(corners) for view in build_views(sensor).values()])


def test_no_change_is_the_description_itself(gel_rig):
    parameters = RigParameters(with_layers(gel_rig), EVERYTHING)
    same = parameters.sensor(np.zeros(len(parameters.free)))
    np.testing.assert_array_equal(pixels(same), pixels(with_layers(gel_rig)))


def test_every_optical_value_is_varied_and_moves_the_pattern(gel_rig):
    """A parameter that `sensor` forgets would look as determined as its prior."""
    mirrors, two, one = with_layers(gel_rig), two_view_rig(gel_rig), one_view_rig(gel_rig)
    # Gel 6, two mirrors of 3, camera 4 and distortion 5, two layers of 2; each view 6 + 9.
    for sensor, count in ((mirrors, 6 + 6 + 9 + 4), (two, 2 * 15), (one, 6 + 9)):
        parameters = RigParameters(sensor, EVERYTHING)
        assert len(parameters.free) == len(parameters.all) == count
        at_rest = pixels(sensor)
        for k, width in enumerate(parameters.prior_std):
            changes = np.zeros(count)
            changes[k] = width / 10
            moved = np.abs(pixels(parameters.sensor(changes)) - at_rest).max()
            assert moved > 1e-4, parameters.names[k]


def test_what_has_no_prior_is_held(gel_rig):
    parameters = RigParameters(gel_rig, RigPrior(focal=0.0), held=("gel",))
    assert "camera.fx" not in parameters.names
    assert "camera.fx" in [item.name for item in parameters.all]
    assert not any(name.startswith("gel") for name in parameters.names)
    assert not any("distortion" in name or "fy" in name for name in parameters.names)


def test_changed_descriptions_can_be_written_and_read(gel_rig, tmp_path):
    """Normals and rotations stay exact, else the reader refuses them."""
    parameters = RigParameters(gel_rig)
    rng = np.random.default_rng(4)
    changed = parameters.sensor(rng.normal(size=len(parameters.free)) * parameters.prior_std)
    path = tmp_path / "sensor.yaml"
    write_sensor_description(path, changed)
    read = SensorDescription.load(path)
    np.testing.assert_array_equal(pixels(read), pixels(changed))
