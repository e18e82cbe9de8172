#!/usr/bin/env python3
"""How fast a held capsule creeps out of two fingers, beside MuJoCo's own contact.

    setup/run python3 benchmarks/grasp_creep.py

A capsule of 8 mm and 45 g hangs between two fingers for ten seconds; friction could carry 19 times
its weight. Coulomb's law holds it still.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import mujoco
from tables import CommandLine, head, line

from cmp_tactile_simulation.grasp.play import Grasp
from cmp_tactile_simulation.grasp.scene import GraspPhase, load_grasp

RADIUS_M, MASS_KG, FRICTION, GRIP_N = 4e-3, 0.045, 0.7, 6.0
# Half of a finger's sides.
THIN_M, WIDE_M = 0.003, 0.011
SETTLED_S, HELD_S = 1.0, 10.0
FINGER = """<body name="{side}" pos="{x} 0 0.1"><joint name="{side}" type="slide" axis="{axis} 0 0"
  damping="20"/><geom type="box" size="{thin} {wide} {wide}" mass=".05"/></body>"""
MODEL = """<mujoco><option timestep="5e-4" integrator="implicitfast" {option}/>
  <default><geom friction="{friction}" condim="4"/></default><worldbody>{fingers}
  <body name="held" pos="0 0 0.1"><freejoint/><geom type="capsule" euler="90 0 0"
    size="{radius} .011" mass="{mass}"/></body></worldbody>
  <actuator><motor joint="left"/><motor joint="right"/></actuator></mujoco>"""
OPTIONS = {
    "MuJoCo, by default": "",
    "MuJoCo, `impratio` 10, as its documentation advises": 'cone="elliptic" impratio="10"',
    "MuJoCo, and 10 `noslip_iterations`": 'cone="elliptic" impratio="10" noslip_iterations="10"',
}


def in_mujoco(option: str) -> float:
    """Speed downwards, m/s."""
    away, size = RADIUS_M + THIN_M, {"thin": THIN_M, "wide": WIDE_M}
    sides = ("left", -away, 1), ("right", away, -1)
    fingers = [FINGER.format(side=side, x=x, axis=axis, **size) for side, x, axis in sides]
    text = MODEL.format(
        option=option, friction=FRICTION, fingers="".join(fingers), radius=RADIUS_M, mass=MASS_KG
    )
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.ctrl[:] = GRIP_N
    mujoco.mj_step(model, data, round(SETTLED_S / model.opt.timestep))
    begin = float(data.body("held").xpos[2])
    mujoco.mj_step(model, data, round(HELD_S / model.opt.timestep))
    return (begin - float(data.body("held").xpos[2])) / HELD_S


def in_gels() -> float:
    """Speed downwards, m/s."""
    handle = load_grasp("screwdriver")
    values = {"radius": RADIUS_M, "length": 0.03, "edge_radius": 5e-4}
    scene = replace(
        handle,
        object=replace(handle.object, values=values, friction=FRICTION),
        mass=MASS_KG,
        position=(0.0, 0.0, RADIUS_M),
        gripper=replace(handle.gripper, opening=0.014, height=RADIUS_M),
        motion=(
            GraspPhase(name="close", duration=0.5, grip=GRIP_N),
            GraspPhase(name="lift", duration=0.8, lift=0.03),
            GraspPhase(name="settle", duration=SETTLED_S),
            GraspPhase(name="hold", duration=HELD_S),
        ),
    )
    frames = [frame for frame in Grasp(scene, pictures=False).frames() if frame.phase == "hold"]
    begin, end = (
        frame.held.position[2] - frame.fingertips["left"].position[2]
        for frame in (frames[0], frames[-1])
    )
    return float(begin - end) * scene.rate / (len(frames) - 1)


def speeds() -> Iterator[tuple[str, float]]:
    """Of each simulator, m/s."""
    yield "cmp_tactile", in_gels()
    for name, option in OPTIONS.items():
        yield name, in_mujoco(option)


def main() -> None:
    """Print the table."""
    CommandLine(__doc__).parse_args()
    print(head("simulator", "creep, um/s"))
    for name, speed in speeds():
        gone = speed * HELD_S > 2 * WIDE_M
        print(line(name, "slides out" if gone else f"{1e6 * abs(speed):.3g}"))


if __name__ == "__main__":
    main()
