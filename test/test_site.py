"""`make docs` builds a site whose links hold, that needs no network, with every public name.

Reports of the kind: mkdocs-material 6181 (offline, search loads a script from another server), 4282
(read from a disk, search stays silent).
"""

import re
import subprocess
from pathlib import Path

import pytest
import yaml

import cmp_tactile_processing

ROOT = Path(__file__).resolve().parent.parent
LOADED = re.compile(
    r'<(?:script|img|link rel="(?!canonical|next|prev)[a-z ]+")[^>]+="(https?://[^"]+)"'
)


@pytest.fixture(scope="module")
def site():
    """The folder of the site; MkDocs fails at a link or an anchor that leads nowhere."""
    if not list(ROOT.glob(".venv*/bin/uv")):
        pytest.skip("uv is not in this environment")
    done = subprocess.run(["make", "docs"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return ROOT / "site"


def test_every_page_is_read_without_a_network(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        addresses = LOADED.findall(page.read_text(encoding="utf-8"))
        assert not addresses, page.name


def test_every_public_name_has_its_place(site):
    pages = yaml.safe_load((ROOT / "docs" / "site" / "public.yaml").read_text(encoding="utf-8"))
    for page in pages:
        text = (site / "api" / f"{page['file']}.html").read_text(encoding="utf-8")
        for name in page["names"]:
            assert f'id="{name}"' in text
    listed = {name.rpartition(".")[2] for page in pages for name in page["names"]}
    assert set(cmp_tactile_processing.__all__) <= listed


def test_every_command_is_described(site):
    text = (site / "commands.html").read_text(encoding="utf-8")
    for command in ("cmp_tactile process", "cmp_tactile calibrate gel", "cmp_tactile import tac3d"):
        assert f"Usage: {command}" in text
