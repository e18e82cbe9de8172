"""The gel of a sensor: its shape, what its model depends on, when it is built again."""

from __future__ import annotations

import json
import logging
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

from cmp_tactile_processing.elastic.model import ElasticModel, ElasticProblem
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.sensor.parts import PatternSurface


def changed(problem):
    """The same problem with each number and text in it changed in turn."""
    for item in fields(problem):
        value = getattr(problem, item.name)
        if is_dataclass(value):
            variants = changed(value)
        elif isinstance(value, tuple):
            variants = [
                (*value[:index], value[index] * 1.01, *value[index + 1 :])
                for index in range(len(value))
            ]
        elif isinstance(value, str):
            variants = [value + "?"]
        else:
            variants = [value + 1]
        for variant in variants:
            yield replace(problem, **{item.name: variant})


def test_key_changes_with_all_that_the_model_depends_on(sensor):
    problem = ElasticProblem.from_sensor(sensor)
    keys = [json.dumps(variant.key, sort_keys=True) for variant in changed(problem)]
    assert len(keys) > 20
    assert len({*keys, json.dumps(problem.key, sort_keys=True)}) == len(keys) + 1


def test_model_is_built_once_for_any_stiffness(other_rig, tmp_path, caplog):
    """Compliance goes with 1 / E; only the ratio of the two moduli needs another solution."""
    caplog.set_level(logging.INFO, "cmp_tactile_processing")
    rig, reported = other_rig(8, 13, PatternSurface()), []
    first = ElasticModel(rig, tmp_path, lambda text, done: reported.append((text, done)))
    assert "building the elastic model of plane_8x13" in caplog.messages[0]
    caplog.clear()
    assert [done for _, done in reported] == sorted(done for _, done in reported)
    assert reported[-1][1] == 1
    layer = replace(rig.elastomer.shading_layer, young=2 * rig.elastomer.shading_layer.young)
    elastomer = replace(rig.elastomer, young=2 * rig.elastomer.young, shading_layer=layer)
    second = ElasticModel(replace(rig, elastomer=elastomer), tmp_path)
    assert not caplog.records
    assert len(list(tmp_path.iterdir())) == 1
    np.testing.assert_allclose(second.compliance * 2, first.compliance, rtol=1e-12)


def test_a_stiff_skin_counts_by_its_modulus_over_that_of_the_body(sensor):
    skin = replace(sensor.elastomer.shading_layer, young=2e6)
    elastomer = replace(sensor.elastomer, young=5e5, shading_layer=skin)
    assert ElasticProblem.from_sensor(replace(sensor, elastomer=elastomer)).layer_ratio == 4.0


def test_mesh_follows_the_surface(sensor):
    """The marker surface at its level, the contact surface a layer above, the base flat."""
    problem = ElasticProblem.from_sensor(sensor)
    mesh = problem.mesh()
    nodes = mesh.nodes()
    radius = sensor.pattern.surface.radius
    sphere = np.sqrt(radius**2 - (nodes[:, :, 0, :2] ** 2).sum(axis=-1)) - radius
    np.testing.assert_allclose(nodes[:, :, mesh.marker_level, 2], sphere, atol=1e-12)
    np.testing.assert_allclose(nodes[:, :, -1, 2], sphere + 3e-4, atol=1e-12)
    np.testing.assert_allclose(nodes[:, :, 0, 2], -5.7e-3, atol=1e-12)
    np.testing.assert_allclose(nodes[-1, -1, 0, :2], 11e-3)
    assert (np.diff(nodes[..., 2], axis=2) > 0).all()


@pytest.mark.parametrize(
    ("surface", "found"),
    [
        pytest.param(PatternSurface("sphere_cap", 0.0235), "thickness", id="meets the base"),
        pytest.param(PatternSurface("sphere_cap", 0.012), "wider", id="narrower than the block"),
        pytest.param(PatternSurface("cylinder", 0.0105, "x"), "wider", id="cylinder too narrow"),
    ],
)
def test_surface_that_reaches_the_base_is_an_error(sensor, surface, found):
    pattern = replace(sensor.pattern, surface=surface)
    with pytest.raises(InputError, match=rf"sample_rig: elastomer.size .*{found}"):
        ElasticProblem.from_sensor(replace(sensor, pattern=pattern))


@pytest.mark.parametrize("thickness_mm", [1, 6, 80])
def test_thickness_chooses_the_elements_over_the_depth(other_rig, thickness_mm):
    sensor = other_rig(20, 20, PatternSurface())
    size = (*sensor.elastomer.size[:2], thickness_mm * 1e-3)
    sensor = replace(sensor, elastomer=replace(sensor.elastomer, size=size))
    mesh = ElasticProblem.from_sensor(sensor).mesh()
    width, body = mesh.x_edges[1], size[2] - sensor.elastomer.shading_layer.thickness
    highest = (mesh.body[-1] - mesh.body[-2]) * body
    assert highest <= 1.35 * width
    assert len(mesh.body) == 5 or highest > 0.9 * width


def test_more_markers_than_a_response_can_hold_are_refused_by_name(sensor):
    pattern = replace(sensor.pattern, rows=100, cols=100, border="beyond_view")
    with pytest.raises(InputError, match=r"pattern\.rows, pattern\.cols: found 100 x 100"):
        ElasticProblem.from_sensor(replace(sensor, pattern=pattern))
