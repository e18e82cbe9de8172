#!/usr/bin/env python3
"""What `grasp_state` says of the packaged grasps, beside what is true.

    setup/run python3 benchmarks/grasp_state.py
    setup/run python3 benchmarks/grasp_state.py cup flask

Each grasp is simulated, its pictures go through the pipeline of each finger, and the states of both
forces are compared with those that the true forces give, and with the friction of the scene.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from tables import CommandLine, head, line

from cmp_tactile_processing.force.grasp import Finger, GraspEstimator, GraspState, friction_use
from cmp_tactile_processing.measured import SlipState
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_simulation.grasp.play import Grasp, GraspFrame
from cmp_tactile_simulation.grasp.scene import SIDES, GraspScene, load_grasp, packaged_grasps

UP = np.array([0.0, 0.0, 1.0])
# Errors up to so many standard deviations count as within the error bar.
MOST_STD = 2.0
SLIDES = (SlipState.INCIPIENT, SlipState.FULL)


@dataclass(frozen=True)
class Moment:
    """A state as it was measured, and the same of the true forces.

    used: true friction of the finger closer to slip.  weight: that the fingers carry now, N.
    """

    measured: GraspState
    true: GraspState
    used: float
    weight: float


def moments(scene: GraspScene) -> Iterator[Moment]:
    """Of the frames in which both fingers touch and are usable."""
    chains = {side: Pipeline(scene.described[side]) for side in SIDES}
    measuring, knowing = GraspEstimator(), GraspEstimator()
    for frame in Grasp(scene).frames():
        measured, true = {}, {}
        for side, seen in frame.fingers.items():
            if frame.index == 0:
                chains[side].set_reference([seen.image], seen.stamp_ns)
            found = chains[side].process(seen.image, seen.stamp_ns).force
            measured[side] = Finger(found, pose_of(frame, side))
            exact = replace(seen.force, wrench=frame.wrenches[side])
            true[side] = Finger(exact, pose_of(frame, side))
        felt = measuring.update(measured["left"], measured["right"], frame.stamp_ns, UP)
        known = knowing.update(true["left"], true["right"], frame.stamp_ns, UP)
        if felt.usable and (felt.normal_force > 0).all() and (known.normal_force > 0).all():
            used = max(friction_use(true[side].field)[0] for side in SIDES)
            yield Moment(felt, known, used, -float(known.load[:3] @ UP))


def pose_of(frame: GraspFrame, side: str) -> NDArray[np.float64]:
    """Of a gel frame in the world (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = frame.fingertips[side].rotation, frame.fingertips[side].position
    return pose


def errors(pairs: list[tuple[float, float, float]], unit: float = 1.0) -> str:
    """RMS error, largest, and how many are within MOST_STD; of value, truth and deviation.

    Without deviations, as NaN, only the errors.
    """
    known = np.array([pair for pair in pairs if np.isfinite(pair[:2]).all()]).reshape(-1, 3)
    if not len(known):
        return "-"
    off = unit * (known[:, 0] - known[:, 1])
    within = int(np.count_nonzero(np.abs(off) <= MOST_STD * unit * known[:, 2]))
    rms, most = float(np.sqrt((off**2).mean())), float(np.abs(off).max())
    judged = int(np.isfinite(known[:, 2]).sum())
    counted = f" ({within} of {judged})" if judged else ""
    return f"{rms:.2g}, {most:.2g}{counted}"


def row(name: str) -> str:
    """A line of the table."""
    scene = load_grasp(name)
    found = list(moments(scene))
    states = [(item.measured.slip_state, item.true.slip_state) for item in found]
    last = next((m.measured for m in reversed(found) if m.measured.friction_coefficient > 0), None)
    friction = "-"
    if last is not None:
        friction = f"{last.friction_coefficient:.3f} +- {last.friction_std:.3f}"
    grip = [(m.measured.grip_force, m.true.grip_force, m.measured.grip_force_std) for m in found]
    used = [(m.measured.traction_ratio, m.used, np.nan) for m in found]
    margin = [
        (m.measured.slip_margin, 1 - m.used / scene.object.friction, m.measured.slip_margin_std)
        for m in found
    ]
    weight = [
        (m.measured.supported_weight, m.weight, m.measured.supported_weight_std) for m in found
    ]
    full = sum(true is SlipState.FULL for _, true in states)
    reported = sum(true is SlipState.FULL and felt in SLIDES for felt, true in states)
    false = sum(felt is SlipState.FULL and true not in SLIDES for felt, true in states)
    return line(
        f"`{name}`",
        len(found),
        errors(grip, 1e3),
        errors(weight, 1e3),
        errors(used),
        errors(margin),
        f"{friction} ({scene.object.friction:g})",
        f"{reported} of {full}, {false} false",
    )


def main() -> None:
    """Print the table."""
    parser = CommandLine(__doc__)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="default: the packaged ones")
    names = parser.parse_args().scenes or list(packaged_grasps())
    print(
        head(
            *("grasp", "frames", "grip force, mN", "weight, mN"),
            *("friction used", "margin", "friction (true)", "FULL reported"),
        )
    )
    for name in names:
        print(row(name), flush=True)
    print("\nErrors: RMS, largest (how many are within two standard deviations).")


if __name__ == "__main__":
    main()
