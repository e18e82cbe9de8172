"""Recordings that many tests read, made beside the workers: a process of `pytest -n`.

Whoever needs one that is not done yet waits for it.
"""

import os
from pathlib import Path

import pytest

from cmp_tactile_simulation.recording.run import recording_of

# As if installed: the scene `grasp` in a third of its frames, on a coarser mesh.
SHORT_SCENES = Path(__file__).parents[1] / "data" / "short"


def with_short_scenes(patch: pytest.MonkeyPatch) -> None:
    """The names `grasp` and `weigh` mean short scenes, here and in processes started from here."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "")
    patch.setenv("AMENT_PREFIX_PATH", f"{SHORT_SCENES}{os.pathsep}{prefixes}")


def short_recording(scene: str) -> Path:
    """The recording of a short scene; simulated in the first run, then from the cache folder."""
    with pytest.MonkeyPatch.context() as patch:
        with_short_scenes(patch)
        return recording_of(scene)


if __name__ == "__main__":
    short_recording("weigh")
    short_recording("grasp")
    recording_of("grasp")
