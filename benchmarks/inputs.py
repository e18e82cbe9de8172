"""Inputs of the speed benchmarks: packaged scenes, scenes of the folder `scenes`, recordings."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tables import CommandLine

from cmp_tactile_bringup.recordings import library
from cmp_tactile_driver.bags.recording import open_recording
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_simulation.recording.run import recording_of
from cmp_tactile_simulation.scenes.file import VARIANT_MARK

SCENES = Path(__file__).parent / "scenes"
DEFAULT = ("grasp", "slip", "plate:20x20", "plate:36x36")


@dataclass(frozen=True)
class Input:
    """A recording.  name: in tables and results.  sensor_file: of its description."""

    name: str
    path: Path
    sensor_file: str

    @classmethod
    def from_name(cls, name: str, sensor: str | None = None) -> Input:
        """A packaged scene, a scene of this folder, or the path of a recording.

        sensor: file or packaged name, for recordings that have no description.
        A scene is simulated at its first use.  Raises CmpTactileError if there is no such input.
        """
        own, mark, variant = name.partition(VARIANT_MARK)
        if (SCENES / f"{own}.yaml").is_file():
            path = recording_of(f"{SCENES / own}.yaml{mark}{variant}")
            return cls(name, path, library.required_sensor(path, None))
        library.check_source(Path(name))
        path = library.recorded_source(Path(name)).resolve()
        given = sensor if Path(name).exists() else None
        label = f"{path.parent.name}/{path.name}" if Path(name).exists() else name
        return cls(label, path, library.required_sensor(path, given))

    @property
    def sensor(self) -> SensorDescription:
        """Its description."""
        return load_sensor(self.sensor_file)

    def frames(self) -> Iterator[tuple[NDArray[np.uint8], int]]:
        """Images (H, W) or (H, W, 3) and stamps, ns."""
        for item in open_recording(self.path).frames():
            yield item.image, item.stamp_ns


def add_options(parser: CommandLine) -> None:
    """The options --input and --sensor."""
    text = "packaged scenes, scenes of benchmarks/scenes, and recordings"
    parser.option("--input", text, DEFAULT, type=str, nargs="+", metavar="INPUT")
    parser.option("--sensor", "sensor description of recordings that have none", metavar="FILE")


def chosen(options: argparse.Namespace) -> list[Input]:
    """What the options name."""
    return [Input.from_name(name, options.sensor) for name in options.input]
