"""Results of the pipeline for some frames of a simulated grasp; a set to calibrate from."""

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from cmp_tactile_bringup.report.results import (
    DemoResults,
    FrameResult,
    Recording,
    RunFacts,
    find_recording,
)
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import load_sensor

# At rest, pressed, just before the knock, just after, and before opening.
FRAMES = (0, 6, 9, 10, 12)
# The scenes `grasp` and `weigh` in fewer frames, on a coarser mesh.
SHORT_SCENES = Path(__file__).resolve().parents[2] / "test" / "data" / "short"


@pytest.fixture
def own_signals() -> Iterator[None]:
    """The handlers of the tests come back after a runner in this process."""
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def recording(grasp_bag: Path) -> Recording:
    return find_recording(str(grasp_bag))


@pytest.fixture(scope="session")
def results(recording: Recording) -> DemoResults:
    sensor = load_sensor(recording.sensor)
    pipeline = Pipeline(sensor)
    frames = []
    for index, frame in enumerate(BagReader(recording.bag).frames()):
        if index not in FRAMES:
            continue
        made = pipeline.process(frame.image)
        frames.append(
            FrameResult(
                index, frame.stamp_ns, frame.image, made.left, made.right, made.surface, made.force
            )
        )
    run = RunFacts(
        frames_sent=len(frames),
        received={"/sample_rig/wrench": len(frames)},
        grid_latency_s=np.array([0.03, 0.04, 0.05]),
        wrench_latency_s=np.array([]),
        asked_hz=20.0,
        rate_hz=float("nan"),
        stages_s={"Elastic model": 1.5},
        machine={"Machine": "<none>"},
    )
    return DemoResults(sensor, recording, tuple(frames), run)


@pytest.fixture
def images(tmp_path: Path, recording: Recording) -> Path:
    """Three frames of the recording as a folder of images."""
    folder = tmp_path / "in" / "images"
    folder.mkdir(parents=True)
    for k, frame in zip(range(3), BagReader(recording.bag).frames(), strict=False):
        cv2.imwrite(str(folder / f"{k}.png"), frame.image)
    return folder


@pytest.fixture(scope="session")
def practice_set(made_once: Callable[..., Path]) -> Path:
    """The practice set that the tutorial makes, but small and always the same."""
    from cmp_tactile_bringup.command import main

    def make(folder: Path) -> None:
        small = ["--seed", "5", "--images", "10"]
        assert main(["calibrate", "practice", "--output", str(folder), *small]) == 0

    prefixes = os.environ.get("AMENT_PREFIX_PATH", "")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AMENT_PREFIX_PATH", f"{SHORT_SCENES}{os.pathsep}{prefixes}")
        return made_once("practice", make)
