"""What the tests of the paper's reports have in common."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def trial(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Experiments that take no time; processes that are begun find their module."""
    monkeypatch.syspath_prepend(Path(__file__).parent / "trial")
    import paper_trial

    return paper_trial
