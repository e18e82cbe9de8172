"""All that frames need is compiled, or loaded, when a stage is made."""

from __future__ import annotations

from command_output import output_of

COMPILES = """
import sys
from dataclasses import replace
import numpy as np
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.sensor.parts import GelRelaxation
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference, surface_at_rest
from cmp_tactile_processing.tracking.detector import NominalGrid, draw_nominal
from cmp_tactile_processing.tracking.tracker import GridTracker


def versions():
    return {
        f"{name}.{key}": len(value.signatures)
        for name, module in list(sys.modules.items())
        if name.startswith("cmp_tactile_processing.")
        for key, value in vars(module).items()
        if hasattr(value, "signatures")
    }


sensor = load_sensor("sample_rig")
views = build_views(sensor)
nominals = [NominalGrid.of_view(sensor.pattern, view) for view in views.values()]
shape = views["left"].placement.height, views["left"].placement.width
rng = np.random.default_rng(3)
# The second one finds there what the first one has loaded.
trackers = [GridTracker(sensor, view) for view in views]
rigs = [StereoRig(sensor), StereoRig(replace(sensor, views={"left": sensor.views["left"]}))]
gel = replace(sensor.elastomer, model="neo_hookean", relaxation=GelRelaxation(0.1, 2.0))
stage = ForceStage(replace(sensor, elastomer=gel))
rest = surface_at_rest(Reference.nominal(sensor), sensor.pattern.shape)
before = versions()
for number in range(60):
    tracker, nominal = trackers[number % 2], nominals[number % 2]
    image = draw_nominal(nominal, shape, True)
    image = np.clip(image + rng.normal(0, 1 + number % 16, shape), 0, 255).astype(np.uint8)
    for _ in range(number % 4):
        x, y = rng.integers(0, shape[1]), rng.integers(0, shape[0])
        w, h = rng.integers(5, 250, 2)
        image[y : y + h, x : x + w] = rng.integers(0, 256)
    if number % 7 == 3:
        image = np.roll(image, rng.integers(0, 60, 2), (0, 1))
    if number % 11 == 5:
        image[rng.random(shape) < 0.05] = 255
    grid = tracker.track(image)
    rigs[0].triangulate(grid, replace(grid, corners=grid.corners + [40.0, 0.0]))
    rigs[1].triangulate(grid, None)
for tracker, nominal in zip(trackers, nominals):
    tracker.inspect_print([draw_nominal(nominal, shape, True)] * 2)
hollow = np.exp(-(rest.reference[..., :2] ** 2).sum(axis=-1) / 8e-6)[..., None]
for number in range(9):
    moved = hollow * [1e-4 * (number // 3), 0.0, -4e-4] + rng.normal(0, 2e-6, hollow.shape)
    status = np.ones(hollow.shape[:2], np.uint8)
    if number % 3 == 1:
        moved[9:11, 12:14], status[9:11, 12:14] = np.nan, 0
    covariance = np.broadcast_to(np.eye(3) * 4e-12, (*moved.shape, 3)).copy()
    surface = replace(rest, displacement=moved, position=rest.reference + moved, status=status)
    field = stage.process(replace(surface, covariance=covariance), number * 10**8)
    assert field.contact.any()
changed = {name: count for name, count in versions().items() if count != before.get(name)}
print(len(before), changed)
"""


def test_no_frame_compiles_anything():
    """In a process of its own: what another test has compiled would count as there.

    Images with and without faults, and surfaces of a press with and without markers missing.
    """
    count, changed = output_of("-c", COMPILES).split(" ", 1)
    assert int(count) > 50
    assert changed.strip() == "{}"
