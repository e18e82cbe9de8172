"""`cmp_tactile simulate`: what it writes, what it says, and its exit codes."""

from functools import partial

import pytest
import yaml
from command_output import run

from cmp_tactile_driver.bags.reader import BagReader

SCENE = {
    "version": 1,
    "name": "tiny",
    "title": "A small press",
    "source": "test",
    "sensor": {
        "base": "sample_rig",
        "name": "tiny",
        "image": {"width": 128, "height": 96},
        "camera": {"fx": 91.67, "fy": 91.67, "cx": 63.5, "cy": 47.5},
        "views": {"left": {"roi": [0, 0, 64, 96]}, "right": {"roi": [64, 0, 64, 96]}},
        "pattern": {"rows": 4, "cols": 5, "pitch": 0.0028, "points_per_segment": 1},
    },
    "contact_nodes": 10,
    "indenter": {"type": "sphere", "radius": 0.008},
    "start": {"touch": {"at": [0, 0], "clearance": 0.0001}},
    "motion": [
        {"name": "press", "frames": 3, "by": {"position": [0, 0, -0.0005]}},
        {"name": "hold", "frames": 60, "hold": True},
    ],
    "samples": 1,
}


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scenes" / "tiny.yaml"
    path.parent.mkdir()
    path.write_text(yaml.safe_dump(SCENE))
    return path


simulate = partial(run, "simulate")


def test_a_scene_becomes_a_bag_named_after_it(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert simulate(scene, "--frames", 4) == 0
    assert capsys.readouterr().out == "4 frames -> tiny\n"
    assert len(list(BagReader(tmp_path / "tiny").frames())) == 4


def test_a_scene_becomes_images_and_a_video(scene, tmp_path, capsys):
    out = tmp_path / "out"
    given = ("--frames", 2, "--seed", 9, "--format", "png", "--video", "--output", out)
    assert simulate(scene, *given) == 0
    names = {path.name for path in out.iterdir()}
    assert {"000.png", "000.npz", "001.png", "001.npz", "video.mp4", "scene.yaml"} <= names
    assert yaml.safe_load((out / "scene.yaml").read_text())["seed"] == 9


def test_the_packaged_scenes_are_listed_a_line_each(capsys):
    assert simulate("--list") == 0
    rows = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert ["contact_ring", "paper, section IV.C", "Ring of 4 mm radius"] in rows
    assert {"ball:10mm", "ball:20mm", "grasp", "screw"} <= {name for name, _, _ in rows}


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["nothing"], 1, "error: nothing: found no such scene, expected a file or one of ball,"),
        (["ball"], 1, "variants: found nothing, expected one of 10mm, 11mm"),
        ([], 2, "SCENE is required; --list shows the packaged ones"),
        (["grasp", "--frames", "0"], 2, "found '0', expected a whole number from 1 to 100000"),
        (["grasp", "--format", "avi"], 2, "--format: found 'avi', expected one of bag, png"),
    ],
)
def test_mistakes_are_one_line(arguments, code, message, capsys):
    assert simulate(*arguments) == code
    assert message in capsys.readouterr().err.splitlines()[-1]
