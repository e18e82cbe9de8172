"""Arguments of `cmp_tactile calibrate force`: reference sensor, what is known of the gel."""

from __future__ import annotations

import argparse
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from cmp_tactile_bringup.commands.argument_types import number_between, whole_between
from cmp_tactile_processing.calibration.material.compliance import MaterialOptions

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cmp_tactile_bringup.calibration.gel_recording import GelMotion
    from cmp_tactile_bringup.calibration.loads import SensorSampling
    from cmp_tactile_bringup.calibration.wrench_recording import WrenchFrame, WrenchSeries
    from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = [
    "add_gel_knowledge",
    "add_wrench_sensor",
    "check_gel_knowledge",
    "material_options",
    "sampling",
    "wrench_at_frames",
]

# Of the reference sensor, unless told otherwise: what a good six-axis sensor resolves.
WRENCH_STD_N = 0.01
MOST_SAMPLES = 60
# Options by the field of MaterialOptions that they set.
KNOWLEDGE = {
    "young_factor": "--young-factor",
    "poisson": "--poisson-std",
    "thickness": "--thickness-std",
    "layer_thickness": "--layer-thickness-std",
    "layer_factor": "--layer-factor",
    "offset": "--offset-std",
    "model_error": "--model-error",
    "shape_error": "--shape-error",
    "strain_error": "--strain-error",
}
# What --fit takes beside Young's modulus and Poisson's ratio, by its field of MaterialOptions.
DIMENSIONS = {
    "fit_thickness": "thickness",
    "fit_layer_thickness": "layer-thickness",
    "fit_layer_young": "layer-young",
}
# What is known before of each of them, and what holds it.
KNOWN_DIMENSIONS = {
    "thickness": ("thickness", 0.0),
    "layer-thickness": ("layer_thickness", 0.0),
    "layer-young": ("layer_factor", 1.0),
}


def add_wrench_sensor(parser: argparse.ArgumentParser, *, samples: bool = True) -> None:
    """Where the reference sensor is and what its clock is ahead; samples: how it is used, too."""
    group = parser.add_argument_group("reference force sensor")
    group.add_argument(
        "--wrench-rotation",
        nargs=3,
        type=number_between(-360, 360, "degrees"),
        metavar=("X", "Y", "Z"),
        help="turns of its axes from the gel frame's, degrees about the gel's x, then y, then z "
        "direction (default: as /tf_static of the bag has it, or else none)",
    )
    group.add_argument(
        "--wrench-reaction",
        action="store_true",
        help="it tells the opposite of the force on the gel: that of the gel on the object",
    )
    group.add_argument(
        "--time-offset",
        type=number_between(-1e10, 1e10, "s"),
        metavar="SECONDS",
        help="what its clock is ahead of the camera's (default: found from what both tell)",
    )
    if samples:
        _add_sampling(group)


def _add_sampling(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--wrench-position",
        nargs=3,
        type=number_between(-10, 10, "m"),
        metavar=("X", "Y", "Z"),
        help="its origin in the gel frame, m: with it, its torque is used, too",
    )
    group.add_argument(
        "--wrench-std",
        type=number_between(1e-5, 100, "N"),
        default=WRENCH_STD_N,
        metavar="N",
        help="standard deviation of its force (default: %(default)g)",
    )
    group.add_argument(
        "--every-frame",
        action="store_true",
        help="take frames in motion, too, not only where gel and force stand still",
    )
    group.add_argument(
        "--samples",
        type=whole_between(1, 10_000),
        default=MOST_SAMPLES,
        metavar="N",
        help="take at most so many (default: %(default)s)",
    )


def _wrench_frame(
    arguments: argparse.Namespace, sensor: SensorDescription, series: WrenchSeries
) -> WrenchFrame:
    """As the arguments tell it, or else the bag's fixed transforms, or else the gel's own axes."""
    from cmp_tactile_bringup.calibration.wrench_recording import WrenchFrame
    from cmp_tactile_bringup.recordings.library import recorded_source
    from cmp_tactile_bringup.recordings.transforms import fixed_transform

    reaction = arguments.wrench_reaction
    position = getattr(arguments, "wrench_position", None)
    if arguments.wrench_rotation is not None:
        return WrenchFrame.turned(arguments.wrench_rotation, position, reaction=reaction)
    gel_frame = f"{sensor.ros_name}_gel_frame"
    if arguments.input is not None and series.frame_id:
        T = fixed_transform(recorded_source(arguments.input), gel_frame, series.frame_id)
        if T is not None:
            print(f"Force sensor: its frame {series.frame_id} is placed by /tf_static.")
            return WrenchFrame(T[:3, :3], T[:3, 3], reaction)
    print("Force sensor: its axes are taken for the gel's; --wrench-rotation tells others.")
    return WrenchFrame.turned(position=position, reaction=reaction)


def wrench_at_frames(
    arguments: argparse.Namespace,
    sensor: SensorDescription,
    motion: GelMotion,
    series: WrenchSeries,
) -> NDArray[np.float64]:
    """Force and moment on the gel at the frames, (n, 6) N and N m, gel frame; NaN if unknown.

    The clocks' offset is as given, or as estimated, which is told.  Raises RecordingError where
    force and frames have no time in common.
    """
    from math import isnan

    from cmp_tactile_bringup.calibration.wrench_recording import (
        ClockOffset,
        at_frames,
        estimated_offset,
    )

    if arguments.time_offset is not None:
        offset = ClockOffset(arguments.time_offset)
    else:
        offset = estimated_offset(series, motion.stamp_ns, motion.displacement)
        if isnan(offset.correlation):
            print("Clocks: force and motion do not tell how far they are apart; taken as one.")
        else:
            ahead = "ahead of" if offset.seconds >= 0 else "behind"
            print(
                f"Clocks: the force's is {abs(offset.seconds) * 1e3:.1f} ms {ahead} the camera's "
                f"(likeness of force and motion {offset.correlation:.4f})."
            )
    wrench = at_frames(series, motion.stamp_ns, offset.seconds)
    return _wrench_frame(arguments, sensor, series).on_gel(wrench)


def sampling(arguments: argparse.Namespace) -> SensorSampling:
    """Which frames become samples, as the arguments tell it."""
    from cmp_tactile_bringup.calibration.loads import SensorSampling

    return SensorSampling(
        steady=not arguments.every_frame,
        least_frames=arguments.frames,
        most=arguments.samples,
        std=arguments.wrench_std,
    )


def add_gel_knowledge(parser: argparse.ArgumentParser) -> None:
    """What was known of gel and loads before; a deviation of 0 or a factor of 1 holds a value."""
    parser.add_argument(
        "--fit",
        nargs="+",
        choices=list(DIMENSIONS.values()),
        default=[],
        metavar="VALUE",
        help="fit this, too, beside Young's modulus and Poisson's ratio: "
        f"{', '.join(DIMENSIONS.values())} (default: the description is taken for right)",
    )
    group = parser.add_argument_group(
        "what is known before",
        "of what is fitted; 0 for a deviation, or 1 for a factor, holds the description's value",
    )
    by_name = {item.name: item for item in fields(MaterialOptions)}
    for name, option in KNOWLEDGE.items():
        meta = by_name[name].metadata
        group.add_argument(
            option,
            dest=name,
            type=number_between(meta["low"], meta["high"], meta["unit"]),
            default=by_name[name].default,
            metavar="X",
            help=f"{meta['description']} (default: {_text(by_name[name].default, meta['unit'])})",
        )


def _text(value: Any, unit: str) -> str:
    return f"{value:g} {unit}".rstrip()


def check_gel_knowledge(arguments: argparse.Namespace) -> None:
    """End with the usage where something is told of a value that is not to be fitted."""
    for value, (name, holds) in KNOWN_DIMENSIONS.items():
        given = getattr(arguments, name)
        told = given not in {holds, MaterialOptions.__dataclass_fields__[name].default}
        if told and value not in arguments.fit:
            arguments.wrong_usage(f"{KNOWLEDGE[name]} needs --fit {value}")


def material_options(arguments: argparse.Namespace) -> MaterialOptions:
    """What was known before, as the arguments tell it."""
    known = {name: getattr(arguments, name) for name in KNOWLEDGE}
    return MaterialOptions(
        **known, **{name: text in arguments.fit for name, text in DIMENSIONS.items()}
    )
