"""A sensor description loads whole, or says which key of which file is wrong and why."""

from __future__ import annotations

import copy
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.printing.pattern import checker_sides_px
from cmp_tactile_processing.sensor.description import (
    SensorDescription,
    load_sensor,
    packaged_sensors,
    sensor_description_text,
)
from cmp_tactile_processing.sensor.dot_code import dot_map
from cmp_tactile_processing.sensor.parts import RefractingLayer

# A camera's pose with its translation in mm.
MILLIMETRES = [[1, 0, 0, 0], [0, 1, 0, -14], [0, 0, 1, -7]]
SAMPLE = Path(__file__).parents[2] / "config" / "sample_rig.yaml"


@pytest.fixture
def content():
    return yaml.safe_load(SAMPLE.read_text())


@pytest.fixture
def load_text(tmp_path):
    def load_text(text):
        path = tmp_path / "rig.yaml"
        path.write_text(text)
        return SensorDescription.load(path)

    return load_text


@pytest.fixture
def load(load_text):
    return lambda content: load_text(yaml.safe_dump(content))


@pytest.fixture
def load_sample(load_text):
    """Loads the sample with one text in place of another."""
    return lambda old, new: load_text(SAMPLE.read_text().replace(old, new))


def changed(content, key_path, value):
    content = copy.deepcopy(content)
    *parents, last = key_path.split(".")
    section = content
    for key in parents:
        section = section[key]
    if value is None:
        del section[last]
    else:
        section[last] = value
    return content


@pytest.mark.parametrize("name", packaged_sensors())
def test_packaged_sensors_show_their_pattern_in_both_views(name):
    sensor = load_sensor(name)
    for view in build_views(sensor).values():
        q = view.project(sensor.pattern.corners())
        # 10 px of margin: room for the outer checkers and for displacement.
        assert (q > 10).all()
        assert (q < np.array([view.placement.width, view.placement.height]) - 10).all()


def test_a_sensor_that_is_not_there_is_named():
    with pytest.raises(InputError, match=r"nowhere\.yaml.*sample_rig"):
        load_sensor("nowhere.yaml")


def test_a_pattern_too_small_for_a_code_is_refused(content, load):
    content["pattern"] |= {"rows": 4, "cols": 7, "code": "dots"}
    with pytest.raises(InputError, match=r"pattern\.code: found 'dots', expected none, .*5 x 8"):
        load(content)
    content["pattern"] |= {"rows": 5, "cols": 6}
    assert load(content).pattern.dots().shape == (6, 7)


def test_a_coded_pattern_beyond_the_view_is_the_middle_of_the_largest_sheet(content, load):
    content["pattern"] |= {"rows": 25, "cols": 15, "pitch": 5e-4, "border": "beyond_view"}
    content["pattern"] |= {"code": "dots", "code_seed": 3}
    part = load(content).pattern
    whole = dot_map(61, 61, 3)
    np.testing.assert_array_equal(part.dots(), whole[17:43, 22:38])
    # The skin is 22 mm wide, 44 checkers; the sheet begins at checkers of the same place.
    sheet = load(content).sheet
    assert (sheet.rows, sheet.cols) == (43, 43)
    np.testing.assert_array_equal(sheet.dots()[9:-9, 14:-14], part.dots())
    np.testing.assert_array_equal(sheet.dark_checkers()[9:-9, 14:-14], part.dark_checkers())
    np.testing.assert_allclose(sheet.corners()[9:-9, 14:-14], part.corners(), atol=1e-12)
    content["pattern"] |= {"rows": 61}
    with pytest.raises(InputError, match=r"pattern\.code: found 'dots', .* at most 60 rows"):
        load(content)


@pytest.mark.parametrize(
    ("key_path", "value", "expected"),
    [
        ("version", 2, r"version: found 2, expected 1"),
        # Reports: ethz-asl/kalibr 80 and 187; tried: "version: found nothing" of a camera_info.
        (
            "version",
            None,
            r"top level: found 'camera, .*, expected a sensor description with version",
        ),
        ("name", None, r"name: found nothing, expected a text"),
        ("image.width", 4.5, r"image\.width: found 4\.5, expected a whole number from 16"),
        ("pattern.pitch", 0.69, r"pattern\.pitch: found 0\.69, .* m: did you mean 0\.00069\?"),
        ("pattern.code", "dot", r"pattern\.code: found 'dot', expected one of none, dots"),
        ("pattern.code_seed", 3, r"pattern\.code_seed: found 3, .* without code: dots"),
        ("pattern.code_seed", -1, r"pattern\.code_seed: .*a whole number from 0 to 65535"),
        ("optics.T_camera_gel", MILLIMETRES, r".*T_camera_gel: .* mean \[0\.0, -0\.014, -0\.007\]"),
        ("pattern.rows", 80, r"pattern\.rows: found 80, .* 4 to 60; .* beyond_view up to 200"),
        ("pattern.border", "none", r"pattern\.border: found 'none', expected one of in_view, bey"),
        ("camera.fx", 2.6, r"camera\.fx: found 2\.6, expected px, at least 34\.1 .* 2\.6 mm"),
        (
            "optics.T_camera_gel",
            [1, 2],
            r"optics\.T_camera_gel\[0\]: found 1, expected a list of 4",
        ),
        ("optics.T_camera_gel", [[1e308] * 4] * 3, r"optics\.T_camera_gel: .* right-handed"),
        ("trackng", {}, r"trackng: .* no such key; .*; did you mean 'tracking'\?"),
        ("optics.layers", [{"z": 0.1}], r"optics\.layers\[0\]\.index: found nothing"),
        (
            "optics.layers",
            [{"z": -0.01, "index": 1.5}, {"z": -0.02, "index": 1.4}],
            r"optics\.layers\[1\]\.z: found -0\.02, expected more than -0\.01",
        ),
        pytest.param("camera.fx", 10**400, r"camera\.fx: found 1000", id="no float so large"),
        (
            "views.left.roi",
            [0, 0, 600, 900],
            r"views\.left\.roi: .*inside 1024 x 768, the size `image`",
        ),
        ("views.left.mirror.normal", [1, 1, 1], r"views\.left\.mirror\.normal: .*length is 1\.73"),
        ("pattern.surface.radius", 0.005, r"pattern\.surface\.radius: .*a radius"),
        (
            "pattern.surface",
            {"type": "cylinder", "radius": 0.03},
            r"pattern\.surface\.axis: found no",
        ),
        ("elastomer.poisson", 0.5, r"elastomer\.poisson: found 0\.5, expected .* to 0\.4999"),
        ("elastomer.size", [0.01, 0.01, 0.006], r"elastomer\.size: .*at least the markers'"),
        (
            "force",
            {"regularization": float("inf")},
            r"force\.regularization: found inf, expected a",
        ),
        ("tracking", {"detector": "magic"}, r"tracking\.detector: found 'magic', expected one of"),
        ("force", {"two_pass": "on"}, r"force\.two_pass: found 'on', expected true or false"),
        ("slip", {"full_ratio": 2}, r"slip\.full_ratio: found 2, expected a number from 0 to 1"),
        (
            "force",
            {"regularization": -1},
            r"force\.regularization: found -1, expected a number from 0",
        ),
        (
            "slip",
            {"full_ratio": 0.2},
            r"slip\.incipient_ratio: found 0\.35, expected at most slip\.full_ratio, 0\.2",
        ),
        ("gain", 1, r"gain: found 1, expected no such key; allowed: calibration, camera"),
        ("g[ain", 1, r"g\[ain: found 1, expected no such key"),
        ("camera.fx", 0, r"camera\.fx: found 0, expected a number above 0"),
        ("camera.fy", 0, r"camera\.fy: found 0, expected a number above 0"),
        (
            "elastomer.relaxation",
            {"share": 0.2, "time": 0},
            r"elastomer\.relaxation\.time: found 0, expected a number above 0",
        ),
    ],
)
def test_wrong_key_is_named_with_file_found_and_expected(content, load, key_path, value, expected):
    with pytest.raises(InputError, match=rf"rig\.yaml(:\d+)?: {expected}"):
        load(changed(content, key_path, value))


@pytest.mark.parametrize("word", ["auto", "on", "off"])
def test_on_and_off_without_quotes_are_words(content, load_text, word):
    """YAML takes them for true and false, which is not what someone who writes them means."""
    sensor = load_text(yaml.safe_dump(content) + f"force: {{large_press: {word}}}\n")
    assert sensor.force.large_press == word


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: [1", "not a YAML file"),
        ("- 1\n- 2\n", "top level: found .*expected a mapping"),
        ("a: !!python/object/apply:os.system ['true']\n", "a: found the tag !!python/obj"),
        ("? [1, 2]\n: 3\n", "top level: found a key that is a list or a mapping, expected a plain"),
        ("a: [{<<: {b: 1}}]\n", r"a\[0\]: found a merge key"),
        ("a: {b: 1, 'b': 2}\n", r"a: found a duplicate key 'b'"),
        ("a: &a [*a]\n", r"a\[0\]: found an alias .*\*a"),
        ("a: *b\n", r"rig\.yaml:1: a: found an alias of no value before it, \*b"),
        ("a: 1\nb: c\0d\n", r"rig\.yaml:2: not a YAML file: found the character 0x0"),
        pytest.param("version: " + "9" * 5000, "version: found 5000 digits", id="digits"),
        pytest.param("a: " + "[" * 9000, r"a\[0\].*: found more nested levels", id="deep"),
        ("", "top level: found None, expected a mapping"),
    ],
)
def test_what_is_not_a_mapping_of_yaml_is_refused(load_text, text, expected):
    with pytest.raises(InputError, match=expected):
        load_text(text)


def test_binary_huge_and_absent_files_are_refused(tmp_path):
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x80")
    huge = tmp_path / "huge.yaml"
    huge.write_bytes(b"#" * 2_000_000)
    for path in (binary, huge, tmp_path / "absent.yaml", tmp_path):
        with pytest.raises(InputError, match=str(path)):
            SensorDescription.load(path)


@pytest.mark.parametrize("number", ["0512", "0x200", "5_12", "1:30", "08"])
def test_only_decimal_integers_are_numbers(load_sample, number):
    """YAML 1.1 takes 0512 for 330: a part of the frame of another width, and wrong forces."""
    expected = rf"rig\.yaml:\d+: views\.right\.roi\[0\]: found '{number}', expected a decimal"
    with pytest.raises(InputError, match=expected):
        load_sample("roi: [512,", f"roi: [{number},")
    assert load_sample("name: sample_rig", f"name: '{number}'").name == number


def test_all_errors_are_named_at_once_with_their_lines(load_sample):
    with pytest.raises(InputError) as caught:
        load_sample("pattern:\n  rows: 20", "pattern:\n  gap: 1\n  border: no\n  rows: 2")
    first = SAMPLE.read_text().splitlines().index("pattern:") + 2
    found = re.findall(r"rig\.yaml:(\d+): (\S+): found", str(caught.value))
    assert found == [
        (f"{first + 2}", "pattern.rows"),
        (f"{first + 1}", "pattern.border"),
        (f"{first}", "pattern.gap"),
    ]


def test_all_missing_keys_are_named_at_once(content, load):
    del content["name"], content["pattern"]["corner_checker"], content["pattern"]["rows"]
    del content["elastomer"]["young"], content["elastomer"]["shading_layer"]
    with pytest.raises(InputError) as caught:
        load(content)
    found = re.findall(r"(\S+): found nothing, expected", str(caught.value))
    assert found == ["name", "pattern.rows", "pattern.corner_checker", "elastomer.young"]


def test_keys_with_a_default_may_be_left_out(content, load):
    """A file that is written has them, so that another default would change nothing."""
    del content["pattern"]["points_per_segment"], content["elastomer"]["model"]
    for absent in (False, True):
        content["elastomer"]["shading_layer"] = {"thickness": 0}
        if absent:
            del content["elastomer"]["shading_layer"]
        sensor = load(content)
        assert sensor.pattern.points_per_segment == 6
        assert sensor.elastomer.model == "linear"
        layer = sensor.elastomer.shading_layer
        assert (layer.thickness, layer.young) == (0, sensor.elastomer.young)
        written = yaml.safe_load(sensor_description_text(sensor))
        assert written["pattern"]["points_per_segment"] == 6
        assert written["elastomer"]["model"] == "linear"
    content["elastomer"]["shading_layer"] = None
    with pytest.raises(InputError, match=r"shading_layer: found None, expected a mapping"):
        load(content)


def test_a_misspelt_key_is_named_where_the_right_one_is_missing(load_sample):
    expected = r"pattern\.pitch: found nothing, (?s:.*)pattern\.Pich: .*; did you mean 'pitch'\?"
    with pytest.raises(InputError, match=expected):
        load_sample("pitch:", "Pich:")


def alias_bomb():
    """Two kilobytes that stand for 9^12 words."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("text", "where"),
    [
        (alias_bomb(), r"a4\[\d\]"),
        ("version: [" + "1," * 490_000 + "]\n", r"version\[\d+\]"),
        ("a: [" + "x," * 99 + "]\nb: &b [" + "*b," * 9 + "]", r"b\[0\]"),
    ],
    ids=["aliases", "list", "itself"],
)
def test_what_grows_without_bounds_is_refused_where_it_does(load_text, text, where):
    with pytest.raises(InputError, match=rf"rig\.yaml:\d+: {where}: found") as error:
        load_text(text)
    assert len(str(error.value)) < 1000


def test_an_escape_sequence_in_a_key_is_shown_and_not_sent_to_the_terminal(load_text):
    with pytest.raises(InputError, match=r": \\x1b\[31mred\\n: found 1, expected no such"):
        load_text(SAMPLE.read_text() + '"\\e[31mred\\n": 1\n')


def test_exponents_without_a_point_are_numbers(load_sample):
    assert load_sample("young: 500000.0\n", "young: 5e5\n").elastomer.young == 5e5


def test_other_rigs_load(content, load):
    fisheye = changed(content, "camera.model", "equidistant")
    fisheye["camera"]["distortion"] = [0.01, 0.0, 0.0, 0.0]
    assert load(fisheye).camera.model == "equidistant"

    layered = changed(content, "optics.layers", [{"z": -0.014, "index": 1.49}])
    assert load(layered).optics.layers == (RefractingLayer(-0.014, 1.49),)

    one_view = changed(content, "optics.type", "monocular")
    del one_view["views"]["right"]
    assert list(load(one_view).views) == ["left"]

    pose = content["optics"]["T_camera_gel"]
    two_view = changed(content, "optics", {"type": "two_view"})
    for view in two_view["views"].values():
        del view["mirror"]
        view.update(camera=two_view["camera"], T_view_gel=pose)
    del two_view["camera"]
    assert load(two_view).views["right"].T_view_gel.shape == (4, 4)


@pytest.mark.parametrize(
    ("name", "legal"),
    [
        ("finger-2 left", "finger_2_left"),
        ("3rd", "sensor_3rd"),
        ("größe", "gr_e"),
        ("finger - 2", "finger_2"),
        ("__a__b_", "a_b"),
        ("指", "sensor"),
    ],
)
def test_name_becomes_a_legal_ros_name(content, load, name, legal):
    """Of letters, digits and single underscores, as graphs expect.

    Reports: KTH-SML/motion_capture_system 9, strands-labs/robots 3208; tried: a sensor "größe"
    could be processed, and no graph could be started.
    """
    assert load(changed(content, "name", name)).ros_name == legal


def test_a_sensor_that_measures_its_markers_itself_has_neither_camera_nor_views(content, load):
    for key in ("image", "camera", "views"):
        del content[key]
    content["optics"] = {"type": "none"}
    sensor = load(content)
    assert not sensor.views
    assert sensor.camera is None
    content["views"] = {"left": {"roi": [0, 0, 100, 100]}}
    with pytest.raises(InputError, match=r"views: found .* no such key"):
        load(content)


def test_where_a_camera_is_needed_a_sensor_without_one_is_named():
    sensor = load_sensor("tac3d_ad2")
    with pytest.raises(InputError, match=r"tac3d_ad2\.yaml: optics\.type: found none"):
        _ = sensor.frame_size
    with pytest.raises(InputError, match=r"tac3d_ad2\.yaml: optics\.type: found none"):
        Pipeline(sensor).process(np.zeros((768, 1024), np.uint8))
    with pytest.raises(InputError, match=r"tac3d_ad2\.yaml: views: found none"):
        checker_sides_px(sensor)
