"""Processing core of cmp_tactile: from a camera frame to the force on the gel, without ROS.

>>> sensor = SensorDescription.load("sensor.yaml")
>>> pipeline = Pipeline(sensor)
>>> result = pipeline.process(frame)
"""

from pathlib import Path

from cmp_tactile_processing.cache.compiled import use_cache_of_these_sources

# Compiled functions are kept by the path of their file: it is to be one, also where a build folder
# links to the sources.
__path__[:] = [str(Path(folder).resolve()) for folder in __path__]
use_cache_of_these_sources(Path(__file__).parent)

# ruff: noqa: E402 - compiled functions are cached where the line above says
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.pipeline import Pipeline, PipelineResult
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.tracking.tracker import GridTracker

__all__ = [
    "ForceModel",
    "GridTracker",
    "Pipeline",
    "PipelineResult",
    "SensorDescription",
    "StereoRig",
]
