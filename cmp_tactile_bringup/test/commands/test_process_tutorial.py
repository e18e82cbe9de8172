"""docs/tutorials/process.md and its how-to: commands and programs do what the pages say."""

import importlib.util
import re
import shlex
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from cmp_tactile_bringup.command import main
from cmp_tactile_bringup.recordings.results import COLUMNS, unit_of
from cmp_tactile_processing.measured import SlipState

TUTORIAL = Path(__file__).resolve().parents[3] / "docs" / "tutorials" / "process.md"
TEXT = TUTORIAL.read_text(encoding="utf-8")
RESULTS = (TUTORIAL.parents[1] / "process_results.md").read_text(encoding="utf-8")


@pytest.mark.usefixtures("short_scenes", "grasp_bag")
def test_the_commands_and_programs_of_the_tutorial_run(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pyarrow")
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("agg")
    printed = []
    for kind, block in re.findall(r"^```(sh|python)\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL):
        if kind == "sh":
            assert main(shlex.split(block)[1:]) == 0, block
            capsys.readouterr()
        elif "import pandas" not in block or importlib.util.find_spec("pandas"):
            exec(compile(block, str(TUTORIAL), "exec"), {})  # noqa: S102  what the reader runs
            if out := capsys.readouterr().out:
                printed.append(out.splitlines())
    strongest, *chosen, fields, columns = printed
    for lines in chosen:
        assert lines[0].split() == ["fx_N", "fz_N", "slip"]
    normal, _, deviation, unit = strongest[0].split()
    assert unit == "N"
    assert -20 < float(normal) < -1
    assert 0 < float(deviation) < 1
    assert (tmp_path / "force.png").stat().st_size > 10_000
    plotted = {line.get_label(): line.get_ydata() for line in plt.gca().lines}
    assert min(plotted["fz_N"]) == pytest.approx(float(normal), abs=0.01)
    plt.close()
    assert len(fields) == 20
    # What the nodes' forces sum up to is the wrench.
    assert min(float(line.split()[1]) for line in fields) == pytest.approx(float(normal), abs=0.01)
    assert columns == ["20 N"]
    (listed,) = re.findall(r"^\| file \|.*?\n\n", TEXT, re.MULTILINE | re.DOTALL)
    names = set(re.findall(r"^\| `(.*?)`", listed, re.MULTILINE))
    assert {path.name for path in (tmp_path / "results").iterdir()} == names


def test_the_table_of_columns_is_that_of_the_files():
    (listed,) = re.findall(r"^\| column \|.*?\n\n", RESULTS, re.MULTILINE | re.DOTALL)
    rows = [line.split("|") for line in listed.splitlines()[2:] if line]
    named = [(name, row[2]) for row in rows for name in re.findall(r"`(\w+)`", row[1])]
    assert tuple(name for name, _ in named) == COLUMNS
    for name, units in named:
        unit = unit_of(name).replace("1", "")
        assert unit in units.strip().split(", "), name
    names = re.findall(r"`(\w+)`", listed[listed.index("by name: ") :].splitlines()[0])
    assert names == [state.name.lower() for state in sorted(SlipState)]
    numbers = re.findall(r"(\d): ([\w ]+)", listed[listed.index("`slip_state`") :].splitlines()[0])
    assert [(int(number), name.strip().replace(" ", "_")) for number, name in numbers] == [
        (int(state), state.name.lower()) for state in sorted(SlipState)
    ]
