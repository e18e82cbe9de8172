"""The texts of findings: each is used, and each that is used is there."""

import re
from pathlib import Path

from cmp_tactile_processing import calibration
from cmp_tactile_processing.calibration.outcome import finding, finding_texts
from cmp_tactile_processing.errors import Severity

NAME = re.compile(r'\bfinding\(\s*(?:"([^"]+)" if \w+ else )?"([^"]+)"')


def test_every_finding_has_its_texts_and_every_text_its_finding():
    folder = Path(calibration.__file__).parent
    code = "".join(path.read_text() for path in folder.rglob("*.py"))
    used = {name for names in NAME.findall(code) for name in names if name}
    assert used == finding_texts().keys()
    assert all(item.keys() == {"text", "advice"} for item in finding_texts().values())


def test_values_are_filled_in():
    found = finding("few pairs", error=True, both=2, least=3)
    assert found.severity is Severity.ERROR
    assert found.text.startswith("Both views show the board in 2 images; at least 3 are needed")
    assert found.advice == "Hold the board so that both views see it."
    values = {"name": "camera.fx", "share": 1.234, "lean": 3.0}
    assert finding("one direction", error=False, **values).text.startswith(
        "camera.fx is known only"
    )
