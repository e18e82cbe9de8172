"""A written sensor description reads back to the last bit, or nothing is written at all."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.sensor.description import (
    SensorDescription,
    load_sensor,
    packaged_sensors,
    sensor_description_text,
    write_sensor_description,
)
from cmp_tactile_processing.sensor.parameters import (
    ForceParameters,
    TrackingParameters,
    TriangulationParameters,
)
from cmp_tactile_processing.sensor.parts import (
    CalibrationRecord,
    Camera,
    GelRelaxation,
    MaterialRecord,
    Mirror,
    Optics,
    PatternSurface,
    RefractingLayer,
    ViewDescription,
)

RECORD = CalibrationRecord(
    method="gel",
    date="2026-07-01T12:00:00Z",
    frames=10,
    reprojection=0.1 + 0.2,
    ray_gap=1 / 3e6,
    determined=("camera.fx", "gel: turn about x"),
    held=("camera.cx", "yes", "2026-07-01", "#1"),
)

MATERIAL = MaterialRecord(
    method="weights",
    date="2026-07-02T12:00:00Z",
    samples=7,
    normal_std=0.1 / 3,
    tangential_std=0.02,
    young_std=1 / 3e3,
    poisson_std=0.0,
    determined=("young", "poisson"),
    held=("shading_layer.young", "no"),
    source="a bag: /ft/wrench",
)


def with_gel(sensor, **changes):
    return replace(sensor, elastomer=replace(sensor.elastomer, **changes))


def differing_fields(first, second, name="sensor"):
    """Paths of all fields that are not the same to the last bit (-0.0 and NaN included)."""
    if type(first) is not type(second):
        return [name]
    if dataclasses.is_dataclass(first):
        parts = [item.name for item in dataclasses.fields(first) if item.compare]
        pairs = [(part, getattr(first, part), getattr(second, part)) for part in parts]
    elif isinstance(first, Mapping):
        if list(first) != list(second):
            return [name]
        pairs = [(key, first[key], second[key]) for key in first]
    elif isinstance(first, tuple):
        if len(first) != len(second):
            return [name]
        pairs = [(str(k), a, b) for k, (a, b) in enumerate(zip(first, second, strict=True))]
    elif isinstance(first, (float, np.ndarray)):
        return [] if np.asarray(first).tobytes() == np.asarray(second).tobytes() else [name]
    else:
        return [] if first == second else [name]
    return [path for part, a, b in pairs for path in differing_fields(a, b, f"{name}.{part}")]


def turned(sensor, seed):
    """The rig with poses and mirrors that no short decimal holds."""
    rng = np.random.default_rng(seed)
    T = sensor.optics.T_camera_gel.copy()
    T[:3] = Rotation.from_rotvec(rng.normal(0, 1e-2, 3)).as_matrix() @ T[:3]
    views = {}
    for name, view in sensor.views.items():
        normal = view.mirror.normal + rng.normal(0, 1e-3, 3)
        mirror = Mirror(normal / np.linalg.norm(normal), view.mirror.distance + rng.normal(0, 1e-9))
        views[name] = replace(view, mirror=mirror)
    return replace(sensor, optics=replace(sensor.optics, T_camera_gel=T), views=views)


def two_view(sensor, shared):
    """Two plain cameras, each with its own intrinsics, or one of them with those of both."""
    views = {}
    for name, view in build_views(sensor).items():
        camera = Camera("equidistant", 1e3 / 7, 1e5 / 3, 1e-7 / 3, -0.0, (0.1, 1e-17, 0.0, 1e22))
        own = shared if shared is not None and name == "left" else camera
        views[name] = ViewDescription(sensor.views[name].roi, None, own, view.T_view_gel)
    optics = Optics("two_view", None, sensor.optics.layers)
    return replace(sensor, camera=shared, optics=optics, views=views)


def rigs():
    sample = load_sensor("sample_rig")
    one = replace(sample.optics, type="monocular", layers=(RefractingLayer(-0.01 / 3, 1.41),))
    surface = PatternSurface("cylinder", 0.1 / 3, "y")
    return {
        **{name: load_sensor(name) for name in packaged_sensors()},
        **{f"turned {seed}": turned(sample, seed) for seed in range(5)},
        "two views": two_view(sample, None),
        "two views, one camera shared": two_view(sample, sample.camera),
        "monocular, plane, layers": replace(
            sample,
            name="ünï: #1",
            optics=one,
            views={"right": sample.views["right"]},
            pattern=replace(sample.pattern, surface=PatternSurface()),
        ),
        "cylinder, parameters": replace(
            sample,
            name="yes",
            pattern=replace(sample.pattern, surface=surface),
            tracking=TrackingParameters(follow=False, red=1.0, green=-0.5),
            triangulation=TriangulationParameters(method="common_normal", corner_noise=0.1 / 3),
            force=ForceParameters(regularization=1e-9),
        ),
        "coded": replace(sample, pattern=replace(sample.pattern, code="dots", code_seed=9)),
        "calibrated": replace(sample, calibration=RECORD),
        "calibrated, no gap": replace(
            sample, calibration=CalibrationRecord("board", "2026-07-01T12:00:00.5+00:00", 1, 0.0)
        ),
        "weighed": with_gel(sample, calibration=MATERIAL, relaxation=GelRelaxation(0.3, 1 / 3)),
        "weighed, little known": with_gel(
            sample,
            calibration=MaterialRecord("force_sensor", "2026-07-02T12:00:00Z", 1, 0.0, 1e22),
            relaxation=GelRelaxation(0.0, 1e3),
        ),
    }


RIGS = rigs()


@pytest.mark.parametrize("name", RIGS)
def test_written_description_reads_back_to_the_last_bit(tmp_path, name):
    path = tmp_path / "rig.yaml"
    write_sensor_description(path, RIGS[name])
    loaded = SensorDescription.load(path)
    assert differing_fields(loaded, RIGS[name]) == []
    assert sensor_description_text(loaded) == path.read_text(encoding="utf-8")
    # Tools that read YAML 1.1 see the same numbers.
    plain = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert plain["pattern"]["pitch"] == RIGS[name].pattern.pitch
    assert plain["name"] == RIGS[name].name
    assert [item.name for item in tmp_path.iterdir()] == ["rig.yaml"], "a temporary file was left"


def test_parameters_that_are_the_default_are_not_written():
    """Else a new default of a later version would never reach a calibrated sensor."""
    content = yaml.safe_load(sensor_description_text(RIGS["cylinder, parameters"]))
    assert content["tracking"] == {"follow": False, "red": 1.0, "green": -0.5}
    assert content["triangulation"] == {"method": "common_normal", "corner_noise": 0.1 / 3}
    assert content["force"] == {"regularization": 1e-9}
    sections = yaml.safe_load(sensor_description_text(RIGS["sample_rig"]))
    assert not {"tracking", "triangulation", "force", "calibration"} & set(sections)


SAMPLE = RIGS["sample_rig"]


@pytest.mark.parametrize(
    ("broken", "expected"),
    [
        (replace(SAMPLE, camera=replace(SAMPLE.camera, fx=np.nan)), r"camera\.fx: found nan"),
        *(
            (
                replace(SAMPLE, calibration=replace(RECORD, date=date)),
                rf"calibration\.date: found '{date}'",
            )
            for date in ("now", "2026-02-30T12:00:00Z", "2026-07-01T12:00:00", "20260701T120000Z")
        ),
        (
            replace(SAMPLE, calibration=replace(RECORD, held=(1,))),
            r"calibration\.held\[0\]: found 1",
        ),
        (with_gel(SAMPLE, relaxation=GelRelaxation(1.0, 2.0)), r"elastomer\.relaxation\.share"),
    ],
)
def test_description_that_could_not_be_read_is_not_written(tmp_path, broken, expected):
    path = tmp_path / "rig.yaml"
    path.write_text("what was there")
    with pytest.raises(InputError, match=rf"rig\.yaml(:\d+)?: {expected}"):
        write_sensor_description(path, broken)
    assert path.read_text() == "what was there"
    assert [item.name for item in tmp_path.iterdir()] == ["rig.yaml"]


COMMENTED = """\
# A sensor of ours.
# Its values are guesses.
version: 1
name: mine   # "#1" on the shelf
image:
  width: 1024    # assumed
  height: 768
camera: {model: pinhole, fx: 537.0, fy: 537.0, cx: 511.5, cy: 383.5, distortion: [0, 0, 0, 0, 0]}
optics:
  type: mirror_stereo
  # assumed, as the whole lid

  T_camera_gel:        # of the drawing
    - [1.0, 0.0, 0.0, 0.0]
    - [0.0, -0.7179596728076926, -0.6960846990286967, -0.01035789]
    - [0.0, 0.6960846990286967, -0.7179596728076926, -0.00759817]
  layers:
    - {z: -0.0087, index: 1.49}     # lower face, überall
    - {z: -0.0057, index: 1.41}
views:                 # mirrors assumed
  left:
    roi: [0, 0, 512, 768]
    mirror: {normal: [0.29695597, -0.32659202, -0.89730419], distance: -0.007194375}   # glued
  right:
    roi: [512, 0, 512, 768]
    mirror: {normal: [-0.29695597, -0.32659202, -0.89730419], distance: -0.007194375}
pattern:
  rows: 20
  cols: 20
  pitch: 0.0006904761904761905    # assumed: 21 checkers
                                  # over 14.5 mm
  corner_checker: dark
  points_per_segment: 6
  surface: {type: sphere_cap, radius: 0.027}
elastomer:
  size: [0.022, 0.022, 0.006]
  young: 500000.0      # assumed: soft PDMS
  poisson: 0.48        # assumed
  model: linear
  shading_layer:
    thickness: 0.0003
    young: 500000.0    # assumed
# nothing follows
"""


@pytest.fixture
def commented(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(COMMENTED, encoding="utf-8")
    return SensorDescription.load(path)


def test_comments_of_what_stays_the_same_are_kept(commented, tmp_path):
    """The lines stay as they are, but for the indentation of lists.

    Reports of the kind, tried here:
    NousResearch/hermes-agent 92554 (a setting is changed, the reasons beside all others are gone or
    others' stand there): one value is changed, all other comments stay, also above keys and in
    lists.
    terrapower/armi 905, jbeder/yaml-cpp 457 (what the reader drops no writer can keep): they are
    read with the description and go wherever it goes.
    lightbend/config 149 (the first comment lost, one after a blank line moved): both stay.
    """
    same = sensor_description_text(commented)
    assert [line.split() for line in same.splitlines()] == [
        line.split() for line in COMMENTED.splitlines()
    ]
    (tmp_path / "again.yaml").write_text(same, encoding="utf-8")
    assert sensor_description_text(SensorDescription.load(tmp_path / "again.yaml")) == same


def test_a_comment_goes_with_the_value_that_it_is_about(commented):
    mirror = replace(commented.views["left"].mirror, distance=-0.0072)
    views = {**commented.views, "left": replace(commented.views["left"], mirror=mirror)}
    changed = with_gel(replace(commented, views=views), young=2e5)
    before, after = (sensor_description_text(item) for item in (commented, changed))
    gone = {"mirrors assumed", "glued", "soft PDMS"}
    assert {text for text in gone if text in before} == gone
    assert not {text for text in gone if text in after}
    assert "poisson: 0.48        # assumed" in after
    assert "T_camera_gel:        # of the drawing" in after
