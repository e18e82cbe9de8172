"""The examples of the documentation run and are true."""

import json
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from command_output import output_of, printed_by
from documents import assert_printed, blocks, shown_after

from cmp_tactile_bringup.command import main
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing import Pipeline, SensorDescription
from cmp_tactile_processing.measured import SlipState
from cmp_tactile_processing.sensor.description import load_sensor, write_sensor_description
from cmp_tactile_processing.sensor.yaml_text import yaml_value
from cmp_tactile_simulation.recording.truth import read_truth
from cmp_tactile_simulation.scenes.file import packaged_scenes

EXAMPLES = Path(__file__).resolve().parent.parent / "docs" / "examples"
TUTORIALS = EXAMPLES.parent / "tutorials"


def rows_of(printed):
    """The numbers of a table that was printed below its heading."""
    return [[float(item) for item in line.split()] for line in printed.splitlines()[1:]]


def test_offline_example_prints_the_grasp(packaged_grasp):
    printed = printed_by(EXAMPLES / "offline.py")
    # The last digit may be rounded otherwise by another machine.
    shown = shown_after(TUTORIALS / "first_look.md", "docs/examples/offline.py")
    assert_printed(shown, printed, absolute=0.011)
    rows = rows_of(printed)
    assert [row[0] for row in rows] == list(range(0, 60, 5))
    wrench = read_truth(packaged_grasp).wrench
    for number, corners, deepest, *force in rows:
        true = wrench[int(number), :3]
        assert corners == 400
        assert (deepest > 0.1) == (true[2] < 0)
        # What the force stage reaches on another mesh than the simulator's, and noise.
        assert force == pytest.approx(true, abs=0.01 * abs(true[2]) + 0.01)


def printed_by_notebook(name, checked, tmp_path):
    """Lines that its cells print, one after the other, and what is added to them."""
    notebook = json.loads((EXAMPLES / name).read_text(encoding="utf-8"))
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    plt.switch_backend("agg")
    script = tmp_path / "notebook.py"
    script.write_text("\n".join(cells) + checked, encoding="utf-8")
    lines = printed_by(script).splitlines()
    plt.close("all")
    return lines


def test_the_notebook_presses_drags_and_measures(tmp_path):
    checked = """
print(*np.abs(measured - true)[:, :3].max(axis=0))
print(*loop[[0, 6, -1]], *true[-1])
"""
    *_, errors, forces = printed_by_notebook("press.ipynb", checked, tmp_path)
    # What the force stage reaches on another mesh than the simulator's, and noise.
    assert max(map(float, errors.split())) < 0.02
    start, forth, back, *true = map(float, forces.split())
    assert abs(start) < 1e-6
    # Sliding both ways: Coulomb's coefficient times the normal force, at most.
    assert 0.3 * -true[2] < forth <= 0.5 * -true[2] * 1.02
    assert back == pytest.approx(-forth, rel=0.1)


def test_the_notebook_plots_force_and_slip(tmp_path):
    checked = """
print(output)
print(*above.lines[2].get_ydata().round(3), max(below.lines[0].get_ydata()))
print(*axes.lines[2].get_ydata().round(3))
"""
    lines = printed_by_notebook("force_and_slip.ipynb", checked, tmp_path)
    *_, output, pipeline, processed = lines
    shutil.rmtree(output)
    *normal, slip = map(float, pipeline.split())
    # The scene presses with 1.1 N and then slides.
    assert min(normal) == pytest.approx(-1.1, abs=0.05)
    assert normal[0] == 0
    assert slip == SlipState.FULL
    # Counts from the described surface, and not from the first frames: apart by the noise.
    assert list(map(float, processed.split())) == pytest.approx(normal, abs=0.02)


def test_refraction_example_prints_what_the_documentation_says():
    printed = printed_by(EXAMPLES / "refraction.py")
    rows = [[float(item) for item in line.split()[-5:]] for line in printed.splitlines()[2:]]
    document = (EXAMPLES.parent / "optics.md").read_text(encoding="utf-8")
    table = re.findall(r"^\| (?:all|none).*", document, re.MULTILINE)
    assert len(rows) == len(table) == 3
    for row, line in zip(rows, table, strict=True):
        documented = [float(item) for item in re.findall(r"(-?[\d.]+) um", line)]
        # Given to three digits or so.
        assert row == pytest.approx(documented, rel=0.02, abs=0.006)


def test_two_mirrors_are_computed_from_angles_and_lengths(tmp_path):
    """The page's angles and lengths are those of the sample rig, to 0.1 degrees and 0.01 mm."""
    page = EXAMPLES.parent / "calibrate.md"
    section = page.read_text(encoding="utf-8").partition("### Two mirrors")[2]
    script = tmp_path / "mirrors.py"
    script.write_text(blocks(section, "python")[0], encoding="utf-8")
    printed = printed_by(script)
    assert_printed(shown_after(page, "It prints values to copy"), printed, absolute=1.1e-6)
    found, sensor = yaml_value(printed), load_sensor("sample_rig")
    compared = [(found["T_camera_gel"], sensor.optics.T_camera_gel[:3])]
    for view in ("left", "right"):
        mirror = sensor.views[view].mirror
        compared.append((found[view]["normal"], mirror.normal))
        assert found[view]["distance"] == pytest.approx(mirror.distance, abs=2e-5)
    for ours, packaged in compared:
        np.testing.assert_allclose(ours, packaged, atol=np.radians(0.1))
    lengths = np.array(found["T_camera_gel"])[:, 3]
    np.testing.assert_allclose(lengths, sensor.optics.T_camera_gel[:3, 3], atol=2e-5)


def test_the_washer_of_the_tutorial_is_simulated_and_felt(tmp_path):
    """All of its motion on the tutorial's mesh, in fewer samples, as the tutorial's commands do.

    Reports of the kind, tried here:
    RobotLocomotion/drake 9241 (a grip's contact swings and settles only with another step, load or
    tolerance): the washer's release, which failed at frame 39 on machines that round otherwise; it
    ends.
    idaholab/moose 7544 (after a failed solve, a shorter step gives another state): a step that
    failed before it changes no digit of the one that follows.
    """
    scene = (EXAMPLES / "washer" / "washer.yaml").read_text(encoding="utf-8")
    (tmp_path / "washer.yaml").write_text(scene + "samples: 2\n", encoding="utf-8")
    shutil.copy(EXAMPLES / "washer" / "washer.stl", tmp_path)
    bag = tmp_path / "recording"
    command = ["cmp_tactile", "simulate", tmp_path / "washer.yaml", "--output", bag, "--video"]
    subprocess.run(command, check=True, capture_output=True)
    assert (bag / "video.mp4").stat().st_size > 10_000
    printed = printed_by(EXAMPLES / "compare.py", bag)
    rows = rows_of(printed)
    assert [row[0] for row in rows] == list(range(0, 47, 5))
    for _, corners_px, surface_um, found, true, *moments in rows:
        # The detector's noise at this sensor's blur, and what it makes in depth.
        assert corners_px < 0.05
        assert surface_um < 5
        assert found == pytest.approx(true, abs=0.1 * abs(true) + 0.1)
        assert moments[0] == pytest.approx(moments[1], abs=0.1)
    assert rows[4][4] == pytest.approx(-4, abs=0.01)
    assert rows[-1][4] == 0
    # Noise differs, and where the release slides it depends on rounding.
    shown = shown_after(TUTORIALS / "simulate.md", "docs/examples/compare.py washer")
    assert_printed(shown, printed, rel=0.2, absolute=0.3)


@pytest.mark.usefixtures("short_scenes")
def test_the_comparison_of_one_view(tmp_path):
    """One view measures no depth, and less of the force; the column of positions says so."""
    sample = load_sensor("sample_rig")
    one = replace(
        sample,
        optics=replace(sample.optics, type="monocular"),
        views={"left": sample.views["left"]},
    )
    write_sensor_description(tmp_path / "one_view.yaml", one)
    scene = packaged_scenes()["grasp"].read_text(encoding="utf-8")
    scene = re.sub(r"(?m)^sensor: .*", "sensor: one_view.yaml", scene)
    (tmp_path / "scene.yaml").write_text(scene, encoding="utf-8")
    bag = tmp_path / "bag"
    assert main(["simulate", str(tmp_path / "scene.yaml"), "--output", str(bag)]) == 0
    printed = printed_by(EXAMPLES / "compare.py", bag)
    assert "in x, y um" in printed
    true = read_truth(bag).wrench
    for number, corners_px, off_um, found_z, true_z, *_ in rows_of(printed):
        assert corners_px < 0.05
        assert off_um < 500
        assert np.isfinite(found_z)
        assert true_z == pytest.approx(true[int(number), 2], abs=0.001)


@pytest.mark.parametrize("example", ["compare.py", "offline.py", "weigh.py"])
def test_an_example_says_what_it_needs(example, tmp_path):
    """In one line: of a folder with a description, where there is no recording."""
    write_sensor_description(tmp_path / "sensor.yaml", load_sensor("sample_rig"))
    with pytest.raises(SystemExit, match=rf"\Aerror: {tmp_path}[^\n]*\Z"):
        printed_by(EXAMPLES / example, tmp_path)


@pytest.mark.ros
def test_listening_example_reports_the_grip_that_the_tutorial_plays(ros, packaged_grasp):
    """With what is felt of the frames before and after the grip becomes firm and loose."""
    from cmp_tactile_msgs.msg import ForceField

    pipeline = Pipeline(SensorDescription.load(packaged_grasp / "sensor.yaml"))
    frames = list(BagReader(packaged_grasp).frames())
    felt = [pipeline.process(frames[number].image).force for number in (0, 15, 16, 30, 48, 49)]
    shown = shown_after(TUTORIALS / "first_look.md", "docs/examples/listen.py")
    listener = subprocess.Popen(
        [sys.executable, str(EXAMPLES / "listen.py")], stdout=subprocess.PIPE, text=True
    )
    try:
        publisher = ros.publisher(ForceField, "/sample_rig/force_field")
        for force in felt:
            msg = ForceField(contact_area=force.contact_area)
            msg.wrench.force.z = force.wrench[2]
            publisher.publish(msg)
        said = {}
        while len(said) < len(shown):
            line = listener.stdout.readline()
            if not line.startswith("no force"):
                said.setdefault(line.partition(":")[0], line)
        listener.send_signal(signal.SIGINT)
        assert listener.wait(timeout=60) == 0
    finally:
        listener.kill()
        listener.stdout.close()
    reported = float(said.pop("normal force").split()[2])
    assert min(abs(reported + force.wrench[2]) for force in felt) < 0.06
    shown = [line for line in shown if not line.startswith("normal force")]
    # The last digit may be rounded otherwise by another machine.
    assert_printed(shown, "".join(said.values()), absolute=0.11)


def test_the_network_of_the_tutorial_is_trained_and_tested_beside_the_pipeline(tmp_path):
    """On a few samples, from which it learns nothing; the pipeline needs none."""
    pytest.importorskip("torch")
    dataset = tmp_path / "presses"
    main(["dataset", "presses", "--samples", "12", "--jobs", "1", "--output", str(dataset)])
    printed = printed_by(EXAMPLES / "learn_wrench.py", dataset, "2", "1").splitlines()
    assert printed[0].startswith("trained on ")
    tests = [line for line in printed[2:] if not line.startswith("  ")]
    assert [line.partition("held-out ")[2] for line in tests] == [
        "samples",
        "object (ring)",
        "light",
        "sensors",
    ]
    rows = {
        name: [float(item) for item in line.removeprefix(f"  {name}").split()]
        for line in reversed(printed)
        for name in ("the force itself", "network", "pipeline")
        if line.startswith(f"  {name}")
    }
    assert rows["network"][0] == rows["pipeline"][0] == 2
    # Of held-out samples, for which the description of the sensor is true.
    assert max(rows["pipeline"][1:4]) < 0.02 * max(rows["the force itself"][1:4])


def test_the_network_says_what_it_needs(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(SystemExit, match="error: this example needs PyTorch: pip install torch"):
        printed_by(EXAMPLES / "learn_wrench.py", "presses")


@pytest.fixture
def live(tmp_path):
    """`cmp_tactile live grasp` as the tutorial runs it; Ctrl-C ends it, without a traceback."""
    command = [sys.executable, "-m", "cmp_tactile_bringup.command", "live", "grasp"]
    with (tmp_path / "live.log").open("w") as log:
        process = subprocess.Popen([*command, "autoplay:=false"], stdout=log, stderr=log)
    yield process
    try:
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
    finally:
        process.kill()
    assert "Traceback" not in (tmp_path / "live.log").read_text()


@pytest.mark.ros
@pytest.mark.usefixtures("live")
def test_the_example_that_moves_the_indenter_feels_what_is_true():
    """With the scene that is packaged."""
    hand = output_of(EXAMPLES / "move_indenter.py", "sample_rig")
    lines = hand.splitlines()
    assert [line.split()[0] for line in lines] == ["pressed", "dragged", "released"]
    forces = {}
    for line in lines:
        felt, true = (
            [float(number) for number in part.split(",")] for part in re.findall(r"\((.*?)\)", line)
        )
        # What the force stage reaches on another mesh than the simulator's, and noise.
        assert felt == pytest.approx(true, abs=0.1 * abs(true[2]) + 0.1)
        forces[line.split()[0]] = true
    assert forces["pressed"] == pytest.approx([0, 0, -2], abs=0.03)
    assert forces["dragged"][0] > 0.3
    assert forces["released"] == [0, 0, 0]
    shown = shown_after(TUTORIALS / "first_look.md", "docs/examples/move_indenter.py sample_rig")
    # The load is reached within 1 %, in steps that depend on the machine.
    assert_printed(shown, hand, absolute=0.03)


@pytest.mark.ros
@pytest.mark.usefixtures("short_scenes", "live")
def test_the_example_of_a_controller_zeroes_and_closes_in_proportion(ros):
    """Beside a live sensor that is pressed with 1.5 N after the zero."""
    from geometry_msgs.msg import WrenchStamped

    # A busy machine is late.
    given = ["--ros-args", "-p", "oldest:=60.0"]
    command = [sys.executable, str(EXAMPLES / "controller.py"), *given]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as controller:
        try:
            zeroed = next(line for line in controller.stdout if line.startswith("zero: reference"))
            assert "but" not in zeroed
            loads = ros.publisher(WrenchStamped, "/sample_rig/indenter/load")
            load = WrenchStamped()
            load.header.frame_id, load.wrench.force.z = "sample_rig_gel_frame", -1.5
            loads.publish(load)
            rows = []
            for line in controller.stdout:
                if line.startswith("felt"):
                    rows.append([float(item) for item in re.findall(r"-?[\d.]+(?= N| mm)", line)])
                # What the force stage reaches on another mesh than the simulator's, and noise.
                if rows and abs(rows[-1][0] - 1.5) < 0.1:
                    break
            controller.send_signal(signal.SIGINT)
            assert controller.wait(timeout=60) == 0
        finally:
            controller.kill()
    assert rows[0][0] == pytest.approx(0, abs=0.1)
    for felt, closing in rows:
        # 50 um for each N that lacks of 2 N.
        assert closing == pytest.approx(0.05 * (2 - felt), abs=1e-4)
