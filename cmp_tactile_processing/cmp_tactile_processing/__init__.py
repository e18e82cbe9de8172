"""Processing core of cmp_tactile: from a camera frame to the force on the gel, without ROS.

>>> sensor = SensorDescription.load("sensor.yaml")
>>> pipeline = Pipeline(sensor)
>>> result = pipeline.process(frame)
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cmp_tactile_processing.cache.compiled import use_cache_of_these_sources

# Compiled functions are kept by the path of their file: it is to be one, also where a build folder
# links to the sources.
__path__[:] = [str(Path(folder).resolve()) for folder in __path__]
use_cache_of_these_sources()

if TYPE_CHECKING:
    from cmp_tactile_processing.force.model import ForceModel
    from cmp_tactile_processing.pipeline import Pipeline, PipelineResult
    from cmp_tactile_processing.sensor.description import SensorDescription
    from cmp_tactile_processing.stereo.rig import StereoRig
    from cmp_tactile_processing.tables import load
    from cmp_tactile_processing.tracking.tracker import GridTracker

__all__ = [
    "ForceModel",
    "GridTracker",
    "Pipeline",
    "PipelineResult",
    "SensorDescription",
    "StereoRig",
    "load",
]

# Imported with the first use of the name (PEP 562): a stage takes a second to import.
MODULES = {
    "ForceModel": "force.model",
    "GridTracker": "tracking.tracker",
    "Pipeline": "pipeline",
    "PipelineResult": "pipeline",
    "SensorDescription": "sensor.description",
    "StereoRig": "stereo.rig",
    "load": "tables",
}


def __getattr__(name: str) -> Any:
    if name not in MODULES:
        msg = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(msg)
    value = getattr(import_module(f"{__name__}.{MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
