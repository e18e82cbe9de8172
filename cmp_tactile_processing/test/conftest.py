"""The sample frames with their truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

DATA = Path(__file__).parent / "data"


@pytest.fixture
def count_calls(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any, str], list[None]]:
    """Wraps a function of a module; the list it returns grows with every call."""

    def wrap(module: Any, name: str) -> list[None]:
        calls: list[None] = []
        function = getattr(module, name)

        def counting(*args: Any, **kwargs: Any) -> Any:
            calls.append(None)
            return function(*args, **kwargs)

        monkeypatch.setattr(module, name, counting)
        return calls

    return wrap


class Sample:
    """A sample frame, (768, 1024) uint8, with its truth."""

    def __init__(self, name: str) -> None:
        import cv2

        self.frame = cv2.imread(str(DATA / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        with np.load(DATA / f"{name}.npz", allow_pickle=False) as truth:
            self.truth = {key: truth[key] for key in truth.files}


@pytest.fixture(scope="session")
def sample() -> Callable[[str], Sample]:
    """Sample frames by name: rest, slide, press."""
    return Sample
