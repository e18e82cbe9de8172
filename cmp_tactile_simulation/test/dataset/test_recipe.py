"""Recipes: what they draw, and what is refused with file, line and key."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from jsonschema import Draft202012Validator

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.sensor.yaml_file import read_yaml
from cmp_tactile_simulation.dataset.distribution import CUT, Distribution
from cmp_tactile_simulation.dataset.recipe import (
    load_recipe,
    packaged_recipes,
    read_recipe,
    recipe_schema,
)
from cmp_tactile_simulation.dataset.sampling import described, draw, variant_sensor

CONTENT: dict[str, Any] = {
    "version": 1,
    "name": "mine",
    "sensor": "sample_rig",
    "indenters": [{"type": "sphere", "radius": {"uniform": [0.002, 0.004]}}],
}
COUNT = 4000


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Writes the recipe with some keys changed; None leaves a key out."""

    def written(**changes: Any) -> Path:
        content = {**CONTENT, **changes}
        content = {key: value for key, value in content.items() if value is not None}
        path = tmp_path / "mine.yaml"
        path.write_text(yaml.safe_dump(content, sort_keys=False))
        return path

    return written


@pytest.mark.parametrize("name", packaged_recipes())
def test_packaged_recipes_fit_their_schema_and_draw_samples(name):
    path = packaged_recipes()[name]
    assert not list(Draft202012Validator(recipe_schema()).iter_errors(read_yaml(path).content))
    recipe = load_recipe(name)
    for number in range(20):
        draw(recipe, number).body()


@pytest.mark.parametrize(
    ("given", "mean", "std"),
    [
        # Of x in [1, 3]: mean 2, std 2 / sqrt(12).
        (Distribution("uniform", (1.0, 3.0)), 2.0, 0.577),
        # Of log x uniform: (b - a) / ln(b / a), and (b^2 - a^2) / (2 ln(b / a)) - mean^2.
        (Distribution("log_uniform", (1.0, 10.0)), 3.909, 2.494),
        # Cut at 3 deviations: 0.9865 of the std.
        (Distribution("normal", (5.0, 2.0)), 5.0, 1.973),
        (Distribution("choice", (1.0, 1.0, 4.0)), 2.0, 1.414),
        (Distribution("fixed", (7.0,)), 7.0, 0.0),
    ],
)
def test_draws_have_the_moments_of_their_distribution(given, mean, std):
    rng = np.random.default_rng(0)
    drawn = np.array([given.draw(rng) for _ in range(COUNT)])
    # Four deviations of a mean and of a std of COUNT draws.
    tolerance = 4 * std / COUNT**0.5
    assert drawn.mean() == pytest.approx(mean, abs=tolerance + 1e-9)
    assert drawn.std() == pytest.approx(std, abs=tolerance + 1e-3)
    low, high = given.support
    assert low <= drawn.min() <= drawn.max() <= high
    assert CUT == 3.0


def test_a_sample_follows_from_recipe_and_number_alone(write):
    recipe = read_recipe(write(depth={"uniform": [0.0, 0.001]}, seed=5))
    in_order = [described(draw(recipe, number)) for number in range(6)]
    assert described(draw(recipe, 4)) == in_order[4]
    assert len({row["depth"] for row in in_order}) == 6
    other = read_recipe(write(depth={"uniform": [0.0, 0.001]}, seed=6))
    assert described(draw(other, 4))["depth"] != in_order[4]["depth"]


def test_variants_have_relative_errors_of_the_sensor(write):
    errors = {"elastomer.young": {"uniform": [0.1, 0.2]}, "camera.fx": -0.01}
    recipe = read_recipe(write(variants=3, errors=errors))
    sensors = [variant_sensor(recipe, number) for number in range(3)]
    ratios = [sensor.elastomer.young / recipe.sensor.elastomer.young for sensor in sensors]
    assert all(1.1 <= ratio <= 1.2 for ratio in ratios)
    assert len(set(ratios)) == 3
    for sensor in sensors:
        assert sensor.camera.fx == pytest.approx(0.99 * recipe.sensor.camera.fx)
        assert sensor.camera.fy == recipe.sensor.camera.fy
    assert [draw(recipe, number).variant for number in range(4)] == [0, 1, 2, 0]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"depth": {"unifrom": [0, 1e-3]}}, ["depth.unifrom", "did you mean 'uniform'"]),
        ({"depth": {"uniform": [2e-3, 1e-3]}}, ["depth.uniform", "low <= high"]),
        ({"depth": {"uniform": [0, 1]}}, ["depth", "0 to 0.005 m"]),
        ({"depth": {"normal": [0.001, 0.001]}}, ["depth", "-0.002 to 0.004"]),
        ({"friction": {"log_uniform": [0, 1]}}, ["friction.log_uniform", "0 < low"]),
        ({"friction": {"choice": []}}, ["friction.choice", "one or more numbers"]),
        ({"friction": "rough"}, ["friction", "'rough'", "uniform"]),
        ({"indenters": []}, ["indenters", "one or more"]),
        ({"indenters": [{"type": "spere", "radius": 0.003}]}, ["indenters[0].type", "'sphere'"]),
        ({"indenters": [{"type": "sphere"}]}, ["indenters[0].radius", "nothing"]),
        ({"indenters": [{"meshes": "nowhere"}]}, ["indenters[0].meshes", "nowhere"]),
        ({"errors": {"elastomer.yuong": 0.1}}, ["errors", "did you mean 'elastomer.young'"]),
        ({"variants": 2}, ["errors", "variants"]),
        ({"history": []}, ["history", "one or more phases"]),
        ({"sensor": "nosuch"}, ["sensor", "nosuch"]),
        ({"dept": 1e-3}, ["dept", "did you mean 'depth'"]),
        ({"camera": {"read_noise": {"uniform": [0, 1000]}}}, ["camera.read_noise", "100"]),
        ({"version": None}, ["version"]),
    ],
)
def test_what_is_wrong_is_named_with_its_place(write, changes, said):
    path = write(**changes)
    with pytest.raises(InputError) as raised:
        read_recipe(path)
    text = str(raised.value)
    assert text.startswith(f"{path}")
    for words in said:
        assert words in text


def test_a_mesh_that_is_not_closed_is_refused_before_any_sample(write, tmp_path):
    folder = tmp_path / "objects"
    folder.mkdir()
    open_mesh = "solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n"
    open_mesh += "vertex 0 1 0\nendloop\nendfacet\nendsolid s\n"
    (folder / "open.stl").write_text(open_mesh)
    with pytest.raises(InputError, match=r"open\.stl"):
        read_recipe(write(indenters=[{"meshes": "objects", "scale": 0.001}]))


def test_an_unknown_recipe_is_asked_for():
    with pytest.raises(InputError, match="did you mean 'presses'"):
        load_recipe("preses")
