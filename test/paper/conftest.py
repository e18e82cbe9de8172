"""What the tests of the paper's reports have in common."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from paper import figure_style


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are made, but not drawn into their files: for tests that read what is said."""

    def close(figure: Figure, path: Path) -> Path:
        plt.close(figure)
        return path

    monkeypatch.setattr(figure_style, "save", close)
