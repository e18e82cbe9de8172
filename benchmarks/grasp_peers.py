#!/usr/bin/env python3
"""The force of a ball on a gel with a known answer, beside other simulators.

A rigid ball is pressed on a flat block of gel on a rigid base, and is then sheared. The block has
the size and the material of the sample rig's gel wherever a simulator has a material. Needs
MuJoCo; pybullet is compared where it is installed.

Known answer: the frictionless contact of a ball with an elastic layer on a rigid base, by the dual
integral equation of Lebedev and Ufliand (J. Appl. Math. Mech. 22, 1958) with Sneddon's function of
a ball. On a thick layer it is Hertz' force. Shear: the same equation for a contact that sticks,
with the mean of the layer's responses along the shear and across it (on a half space, Mindlin's
8 G a / (2 - nu)). Sliding: Coulomb's law.
"""

from __future__ import annotations

import importlib
import importlib.util
import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from tables import CommandLine, head, line

from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.sensor.parts import Elastomer, PatternSurface, ShadingLayer
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.gel import LinearElastomer
from cmp_tactile_simulation.indenter_shapes import Sphere

Array = NDArray[np.float64]

RADII_M = (8e-3, 4e-3)
DEPTHS_M = (5e-5, 1e-4, 2e-4, 3e-4, 4e-4)
# Springs are fitted to the known force of the first ball at this depth, and all are sheared there.
FITTED_M = 2e-4
SHEAR_M, REST_S, SLIDE_M, SPEED_M_S, FRICTION = 5e-6, 0.2, 2e-4, 2e-4, 0.5
# The ball in the rigid worlds: its mass, and the stiffness of the drives that hold it.
BALL_KG, DRIVE_N_M = 0.1, 2e4
PAD = '<geom name="pad" type="box" size=".011 .011 .003" pos="0 0 -.003"/>'
# Taxels along each side of MuJoCo's sensor.
TAXELS, TAXEL_M = 41, 2e-4
# Cells of the flex: width under the ball, how many of this width, and growth outwards.  As nothing
# moves in the end, the flex is heavy, for longer steps.
CELL_M, FINE_CELLS, GROWTH, FLEX_KG = 5e-4, 4, 1.5, 10.0
HEADER = """# The force of a ball on a gel, beside other simulators

Made by `grasp_peers.py`. Errors of the normal force by depth, and the median time of a press:
"""
SHEARED = """
Tangential force of the ball of 8 mm at a depth of 0.2 mm: error of its stiffness in the first
5 um, what is left of it 0.2 s later, and the error of the force while the ball slides:
"""


class Layer:
    """The known answers for an elastic layer on a rigid base."""

    def __init__(self, gel: Elastomer) -> None:
        nu, self._h = gel.poisson, gel.size[2]
        points, weights = np.polynomial.legendre.leggauss(300)
        w, self._share = 15 * (points + 1), 15 * weights
        # Responses of the layer over those of the half space at each wave number.
        k, self._wave = 3 - 4 * nu, w / self._h
        lower = 2 * k * np.cosh(2 * w) + 1 + k**2 + 4 * w**2
        self._normal = (2 * k * np.sinh(2 * w) - 4 * w) / lower
        along = (2 * k * np.sinh(2 * w) + 4 * w) / lower
        self._tangential = ((1 - nu) * along + np.tanh(w)) / (2 - nu)
        self._moduli = gel.young / (1 - nu**2), 2 * gel.young / ((1 + nu) * (2 - nu))

    def force(self, radius: float, depth: float) -> tuple[float, float]:
        """Normal force, N, and radius of contact, m, of a ball of `radius` m at a depth, m."""
        contacts = np.geomspace(5e-5, 0.5 * radius, 80)
        known = np.log([self._press(radius, contact) for contact in contacts]).T
        at = np.log(depth), known[0]
        return float(np.exp(np.interp(*at, known[1]))), float(np.interp(*at, contacts))

    def shear_stiffness(self, contact: float) -> float:
        """N/m of a contact of this radius, m, that sticks."""
        t, weight, matrix = self._equation(contact, self._tangential)
        unit = np.linalg.solve(matrix, np.full_like(t, 2 / np.pi))
        return float(np.pi * self._moduli[1] * weight @ unit)

    def _press(self, radius: float, contact: float) -> tuple[float, float]:
        """Depth, m, and force, N, at which the contact has this radius, m."""
        t, weight, matrix = self._equation(contact, self._normal)
        ball = t / 2 * np.log((radius + t) / (radius - t))
        unit, shape = np.linalg.solve(matrix, 2 / np.pi * np.stack([np.ones_like(t), ball]).T).T
        # The pressure ends at the edge, which is the last point.
        depth = shape[-1] / unit[-1]
        return depth, float(np.pi * self._moduli[0] * weight @ (depth * unit - shape))

    def _equation(self, contact: float, response: Array) -> tuple[Array, Array, Array]:
        """Points of 0..contact, their weights and the matrix of the integral equation there."""
        points, weights = np.polynomial.legendre.leggauss(40)
        t = np.append((points + 1) / 2, 1.0) * contact
        weight = np.append(weights / 2, 0.0) * contact
        waves = np.cos(np.multiply.outer(t, self._wave))
        kernel = 2 / np.pi / self._h * (waves * (self._share * (response - 1))) @ waves.T
        return t, weight, np.eye(len(t)) + kernel * weight


class OurGel:
    """The contact of `Simulator`, without pictures."""

    def __init__(self, radius: float) -> None:
        rig = load_sensor("sample_rig")
        flat = replace(rig.pattern, surface=PatternSurface("plane"))
        gel = LinearElastomer(replace(rig, pattern=flat, elastomer=flat_gel()))
        self._contact = ContactSimulation(gel, Sphere(radius), FRICTION)
        self._at = np.array([0.0, 0.0, gel.node_position[:, 2].max() + radius])
        self._state, self._depth = self._contact.rest(Pose(self._at)), 0.0

    def press(self, depth: float) -> tuple[float, float]:
        """Depth reached, m, and normal force, N."""
        self._depth = depth
        return depth, -float(self._moved(0.0)[2])

    def shear(self, way: float, rest: float = 0.0) -> float:  # noqa: ARG002 - nothing creeps
        """Tangential force, N, where the ball has moved to x = way, m, and rested, s."""
        return float(self._moved(way)[0])

    def _moved(self, x: float) -> Array:
        with one_thread():
            place = Pose(self._at + (x, 0.0, -self._depth))
            self._state = self._contact.move(self._state, place)
        return self._state.resultant


class RigidWorld:
    """A ball that drives hold over something in MuJoCo, until it rests there.

    under: XML of what it is pressed on.  STILL m/s: of all that rests, after at most STEPS.  KEPT:
    share of velocities that a step leaves.
    """

    STEP_S, INTEGRATOR, STILL, STEPS, KEPT = 5e-4, "implicitfast", 1e-8, 20000, 1.0

    def __init__(self, under: str, radius: float, more: str = "") -> None:
        kv = 2 * np.sqrt(DRIVE_N_M * BALL_KG)
        drives = [f'<position joint="{axis}" kp="{DRIVE_N_M}" kv="{kv}"/>' for axis in "xz"]
        self._model = mujoco.MjModel.from_xml_string(f"""<mujoco>
          <option timestep="{self.STEP_S}" integrator="{self.INTEGRATOR}" gravity="0 0 0"
            cone="elliptic" impratio="10"/>
          <size memory="500M"/>
          <default><geom friction="{FRICTION}" condim="3"/></default>
          <worldbody>{under}
            <body name="ball" pos="0 0 {radius}">
              <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
              <geom name="ball" type="sphere" size="{radius}" mass="{BALL_KG}"/>
            </body>
          </worldbody>
          <actuator>{"".join(drives)}</actuator>{more}</mujoco>""")
        self.data = mujoco.MjData(self._model)
        self._x, self._z = (int(self._model.joint(axis).qposadr[0]) for axis in "xz")

    def press(self, depth: float) -> tuple[float, float]:
        """As OurGel."""
        self.data.ctrl[1] = -depth
        for number in range(self.STEPS):
            self._step()
            if number > 20 and np.abs(self.data.qvel).max() < self.STILL:
                break
        return -float(self.data.qpos[self._z]), float(self.data.qfrc_constraint[self._z])

    def shear(self, way: float, rest: float = 0.0) -> float:
        """As OurGel."""
        begin = float(self.data.ctrl[0])
        moving = round(abs(way - begin) / SPEED_M_S / self.STEP_S)
        for x in np.append(np.linspace(begin, way, moving), [way] * round(rest / self.STEP_S)):
            self.data.ctrl[0] = x
            self._step()
        return -float(self.data.qfrc_constraint[self._x])

    def _step(self) -> None:
        mujoco.mj_step(self._model, self.data)
        self.data.qvel *= self.KEPT


class Spring(RigidWorld):
    """MuJoCo's rigid contact with one stiffness, N/m, and friction as stiff as by default."""

    def __init__(self, stiffness: float, radius: float) -> None:
        k = stiffness / BALL_KG
        pair = f'solref="-{k} -{2 * np.sqrt(k)}" solreffriction=".02 1" solimp=".9 .9 .001"'
        pair = f'geom1="ball" geom2="pad" condim="3" friction="{FRICTION} {FRICTION}" {pair}'
        super().__init__(PAD, radius, f"<contact><pair {pair}/></contact>")


class Taxels:
    """MuJoCo's sensor `tactile`: how deep each taxel is in the ball, times a stiffness, N/m."""

    def __init__(self, stiffness: float, radius: float) -> None:
        half = TAXELS * TAXEL_M / 2
        mesh = f'name="skin" builtin="plate" params="{TAXELS} {TAXELS}" scale="{half} {half} 1e-6"'
        skin = '<geom name="skin" type="mesh" mesh="skin" contype="0" conaffinity="0" mass="0"/>'
        more = f"<asset><mesh {mesh}/></asset><sensor><tactile geom='skin' mesh='skin'/></sensor>"
        self._world, self._stiffness = RigidWorld(PAD + skin, radius, more), stiffness

    def press(self, depth: float) -> tuple[float, float]:
        """As OurGel."""
        reached, _ = self._world.press(depth)
        depths = self._world.data.sensordata[: TAXELS**2]
        return reached, self._stiffness * float(depths.mean())


class Bullet:
    """Bullet's contact of one stiffness, N/m, of which TACTO takes the normal force."""

    def __init__(self, stiffness: float, radius: float) -> None:
        self._bullet = bullet = importlib.import_module("pybullet")
        bullet.connect(bullet.DIRECT)
        bullet.resetSimulation()
        bullet.setTimeStep(5e-4)
        shape, self._radius = bullet.createCollisionShape, radius
        block = shape(bullet.GEOM_BOX, halfExtents=[0.011, 0.011, 0.003])
        ball, at = shape(bullet.GEOM_SPHERE, radius=radius), [0, 0, radius]
        self._block = bullet.createMultiBody(0, block, basePosition=[0, 0, -0.003])
        self._ball = bullet.createMultiBody(BALL_KG, ball, basePosition=at)
        for body in (self._block, self._ball):
            bullet.changeDynamics(body, -1, contactStiffness=stiffness, contactDamping=50)
        fixed = -1, -1, -1, bullet.JOINT_FIXED, [0, 0, 0], [0, 0, 0], at
        self._drive = bullet.createConstraint(self._ball, *fixed)

    def press(self, depth: float) -> tuple[float, float]:
        """As OurGel."""
        self._bullet.changeConstraint(self._drive, [0, 0, self._radius - depth], maxForce=1e3)
        for _ in range(400):
            self._bullet.stepSimulation()
        place, _ = self._bullet.getBasePositionAndOrientation(self._ball)
        points = self._bullet.getContactPoints(self._ball, self._block)
        return self._radius - place[2], sum(point[9] for point in points)


class Flex(RigidWorld):
    """MuJoCo's flex: finite elements (linear tetrahedra) of the gel."""

    STEP_S, INTEGRATOR, STILL, STEPS, KEPT = 1e-4, "Euler", 1e-6, 1500, 0.997

    def __init__(self, gel: Elastomer, radius: float) -> None:
        side, depth = _graded(gel.size[0] / 2), -_graded(gel.size[2])
        across = np.concatenate([-side[:0:-1], side])
        grid = np.stack(np.meshgrid(across, across, depth, indexing="ij"), axis=-1)
        number = np.arange(grid[..., 0].size).reshape(grid.shape[:3])
        points = " ".join(f"{value:.7g}" for value in grid.ravel())
        parts = _tetrahedra(number), number[..., -1].ravel()
        elements, base = (" ".join(map(str, part)) for part in parts)
        super().__init__(
            f"""<flexcomp name="gel" type="direct" dim="3" radius="1e-6" mass="{FLEX_KG}"
              point="{points}" element="{elements}"><pin id="{base}"/>
              <elasticity young="{gel.young}" poisson="{gel.poisson}"/>
              <contact selfcollide="none" solref="0.002 1" condim="3" friction="{FRICTION}"
                solimp="0.99 0.999 1e-5"/></flexcomp>""",
            radius,
        )


def _graded(length: float) -> Array:
    """Places from 0 to a length, m, farther and farther apart."""
    steps = [CELL_M] * FINE_CELLS
    while sum(steps) < length:
        steps.append(GROWTH * steps[-1])
    return np.concatenate([[0.0], np.cumsum(steps) * length / sum(steps)])


def _tetrahedra(number: NDArray[np.intp]) -> NDArray[np.intp]:
    """Corners of six of them for each cell of a lattice of points with these numbers."""
    low, high = slice(None, -1), slice(1, None)
    found = []
    for order in itertools.permutations(range(3)):
        at = [low, low, low]
        corners = [number[tuple(at)].ravel()]
        for axis in order:
            at[axis] = high
            corners.append(number[tuple(at)].ravel())
        # All turn alike.
        if np.linalg.det(np.eye(3)[list(order)]) < 0:
            corners[2:] = corners[:1:-1]
        found.append(np.stack(corners, axis=1).ravel())
    return np.concatenate(found)


def flat_gel() -> Elastomer:
    """The sample rig's, of one material."""
    gel = load_sensor("sample_rig").elastomer
    return replace(gel, shading_layer=ShadingLayer(0.0, gel.young))


def fitted(spring: Callable[[float, float], Any], layer: Layer) -> Callable[[float], Any]:
    """A contact by the radius of the ball, with the stiffness that fits at one depth."""
    stiffness = 1e3
    # The force is nearly in proportion to it.
    for _ in range(4):
        depth, force = spring(stiffness, RADII_M[0]).press(FITTED_M)
        stiffness *= layer.force(RADII_M[0], depth)[0] / force
    return partial(spring, stiffness)


def simulators() -> Iterator[tuple[str, Callable[[float], Any], Layer]]:
    """Names, contacts by the radius of the ball, and the layer that each has."""
    gel, other = flat_gel(), replace(flat_gel(), poisson=0.3)
    layer = Layer(gel)
    yield "cmp_tactile", OurGel, layer
    yield "MuJoCo, contact of one stiffness", fitted(Spring, layer), layer
    yield "MuJoCo, sensor `tactile`", fitted(Taxels, layer), layer
    if importlib.util.find_spec("pybullet"):
        yield "TACTO's pybullet, contact of one stiffness", fitted(Bullet, layer), layer
    yield "MuJoCo, flex", partial(Flex, gel), layer
    yield "MuJoCo, flex, on a gel of Poisson's ratio 0.3", partial(Flex, other), Layer(other)


def presses(name: str, contact: Callable[[float], Any], layer: Layer) -> Iterator[str]:
    """A row for each ball."""
    for radius in RADII_M:
        ball, cells, seconds = contact(radius), [], []
        for wanted in DEPTHS_M:
            before = perf_counter()
            depth, force = ball.press(wanted)
            seconds.append(perf_counter() - before)
            cells.append(f"{force / layer.force(radius, depth)[0] - 1:+.1%}")
        yield line(name, f"{1e3 * radius:g} mm", *cells, f"{1e3 * np.median(seconds):,.0f} ms")


def shears(name: str, contact: Callable[[float], Any], layer: Layer) -> str:
    """The row of the tangential force."""
    ball = contact(RADII_M[0])
    if not hasattr(ball, "shear"):
        return line(name, *3 * ["no force"])
    depth, normal = ball.press(FITTED_M)
    stiffness = layer.shear_stiffness(layer.force(RADII_M[0], depth)[1])
    # A mesh that is not symmetric pushes the ball aside.
    aside = ball.shear(0.0)
    first, later, sliding = ball.shear(SHEAR_M), ball.shear(SHEAR_M, REST_S), ball.shear(SLIDE_M)
    first, later = first - aside, later - aside
    # A flex that is heavy does not come to rest in so short a motion.
    stuck = (
        ["not measured"] * 2
        if isinstance(ball, Flex)
        else [f"{first / SHEAR_M / stiffness - 1:+.0%}", f"{later / first:.0%}"]
    )
    return line(name, *stuck, f"{sliding / FRICTION / normal - 1:+.1%}")


def main() -> None:
    """Measure, print and write the tables."""
    parser = CommandLine(__doc__)
    path = Path("benchmark_output/grasp_peers.md")
    parser.option("--output", "file of the tables", path, type=Path)
    options = parser.parse_args()
    # It would write a file into the working folder.
    mujoco.set_mju_user_warning(lambda _: None)
    normal = [head("simulator", "ball", *(f"{1e3 * depth:g} mm" for depth in DEPTHS_M), "time")]
    along = [head("simulator", "stiffness", "left", "sliding")]
    for simulator in simulators():
        normal += presses(*simulator)
        along.append(shears(*simulator))
        print(*normal[-len(RADII_M) :], along[-1], sep="\n", flush=True)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    text = "\n".join([HEADER, *normal, SHEARED, *along])
    options.output.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
