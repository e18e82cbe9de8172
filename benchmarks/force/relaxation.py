#!/usr/bin/env python3
"""Measure the error of the force that relaxation causes, without correction and with it.

The first part uses histories of one force. The displacement of the gel solves its Volterra
equation, by the trapezoidal rule in steps of a quarter of a frame, independently of the filter.
The force that an elastic gel would have at this displacement is compared with the true one. Errors
are relative to the largest true force. The second part (not with --quick) uses whole contacts with
friction, which the simulator computes for a relaxing gel, and gives the error of the resultant.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.material.relaxation import fit_relaxation
from cmp_tactile_processing.elastic.relaxation import RelaxationFilter
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import GelRelaxation
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose
from cmp_tactile_simulation.indenter_shapes import Sphere
from cmp_tactile_simulation.neo_hookean_gel import elastomer_of
from hard_frames.contacts import at_markers

Array = NDArray[np.float64]
Act = Callable[[ContactState], ContactState]
Terms = tuple[tuple[float, float], ...]

FRAME_S, FINE = 1 / 30, 4
# Share and time constant, s, of gels with one term, and of one with two.
GELS: tuple[Terms, ...] = (
    ((0.05, 0.5),),
    ((0.05, 5.0),),
    ((0.1, 2.0),),
    ((0.2, 2.0),),
    ((0.2, 20.0),),
    ((0.3, 5.0),),
)
TWO_TERMS: Terms = ((0.1, 0.5), (0.1, 10.0))
PERIODS_S = (0.5, 2.0, 10.0)
WRONG = 0.2
# Noise of a reading, as a share of the largest force, for the fit and for the gain of noise.
NOISE = 0.005
CONTACT_NODES = 20


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="only the first part")
    quick = parser.parse_args().quick
    print("Largest error in % of the largest true force. loop: width of the hysteresis loop")
    columns = ["weight 30 s", "released", "pressed 30 s", "ramp 10 s"]
    columns += [f"loop {period:g} s" for period in PERIODS_S]
    print(f"{'gel: share, time':34}" + "".join(f"{name:>14}" for name in columns))
    for terms in GELS:
        gel = GelRelaxation(*terms[0])
        named = f"{gel.share:g}, {gel.time:g} s"
        row(f"{named}: left in", terms, None)
        row(f"{'':{len(named)}}  taken out", terms, gel)
        for what, wrong in wrong_ones(gel).items():
            row(f"{'':{len(named)}}  {what}", terms, wrong)
    named = " + ".join(f"{share:g}, {time:g} s" for share, time in TWO_TERMS)
    row(f"{named}: left in", TWO_TERMS, None)
    for hold_s in (5.0, 30.0):
        gel, scale = fitted(TWO_TERMS, hold_s)
        row(f"  one term of {hold_s:g} s of a weight", TWO_TERMS, gel, scale)
    noise_rows()
    if not quick:
        contact_rows()


def wrong_ones(gel: GelRelaxation) -> dict[str, GelRelaxation]:
    """The gel as it would be described with errors of WRONG."""
    return {
        f"{key} {100 * sign * WRONG:+.0f} %": replace(
            gel, **{key: getattr(gel, key) * (1 + sign * WRONG)}
        )
        for key in ("share", "time")
        for sign in (1, -1)
    }


def row(name: str, terms: Terms, gel: GelRelaxation | None, scale: float = 1.0) -> None:
    """One line: what a gel of these terms shows with the relaxation of `gel` taken out.

    scale: calibrated over true modulus of a quick press.
    """
    put_on, taken_off, held_s = 0.5, 0.5, 30.0
    weight = history([(0, 0), (0.5, 0), (0.5 + put_on, 1), (1 + held_s, 1), (61.5, 1)])
    held = np.abs(scale * read(weight, terms, gel) - weight)[: frames(1 + held_s)].max()
    off = history([(0, 0), (0.5, 0), (1, 1), (31, 1), (31 + taken_off, 0), (61.5, 0)])
    dent = np.abs(scale * read(off, terms, gel) - off)[frames(31 + taken_off) :].max()
    press = pressed(terms, [(0, 0), (0.5, 0), (1, 1), (31, 1)])
    press_error = np.abs(scale * filtered(press[1], gel) - press[0]).max() / press[0].max()
    ramp = history([(0, 0), (0.5, 0), (10.5, 1)])
    ramp_error = np.abs(scale * read(ramp, terms, gel) - ramp).max()
    loops = [scale * loop_width(period, terms, gel) for period in PERIODS_S]
    values = [held, dent, press_error, ramp_error, *loops]
    print(f"{name:34}" + "".join(f"{100 * value:14.2f}" for value in values))


def frames(time_s: float) -> int:
    """Number of a frame."""
    return round(time_s / FRAME_S)


def history(points: list[tuple[float, float]]) -> Array:
    """Force at the fine steps, along lines through (s, share of the largest)."""
    at, force = np.array(points).T
    return np.interp(np.arange(0, at[-1], FRAME_S / FINE), at, force)[::FINE]


def fine(values: Array) -> Array:
    """Values at the fine steps: straight lines between frames."""
    count = FINE * (len(values) - 1) + 1
    return np.interp(np.arange(count) / FINE, np.arange(len(values)), values)


def relaxing(terms: Terms, count: int) -> Array:
    """E'(t) at so many fine steps, times a step."""
    step = FRAME_S / FINE
    time = step * np.arange(count)
    return np.asarray(-sum(share / tau * np.exp(-time / tau) for share, tau in terms) * step)


def shown_by(terms: Terms, force: Array) -> Array:
    """What an elastic gel would be read for, of a gel under this force: g of

        force(t) = g(t) + integral of E'(t - s) g(s) ds,    E(t) = 1 - sum of share (1 - exp).

    Trapezoidal rule at the fine steps.
    """
    given = fine(force)
    kernel, shown = relaxing(terms, len(given)), np.zeros_like(given)
    backwards = kernel[::-1].copy()
    for k in range(len(given)):
        past = backwards[-k - 1 : -1] @ shown[:k] - kernel[k] * shown[0] / 2 if k else 0.0
        shown[k] = (given[k] - past) / (1 + kernel[0] / 2)
    return shown[::FINE]


def pressed(terms: Terms, points: list[tuple[float, float]]) -> tuple[Array, Array]:
    """True force and reading where the displacement is given, along lines through the points."""
    shown = history(points)
    given = fine(shown)
    kernel = relaxing(terms, len(given))
    past = np.convolve(kernel, given)[: len(given)] - (kernel[0] * given + kernel * given[0]) / 2
    return (given + past)[::FINE], shown


def read(force: Array, terms: Terms, gel: GelRelaxation | None) -> Array:
    """The force reported of a gel of these terms, with the relaxation of `gel` taken out."""
    return filtered(shown_by(terms, force), gel)


def filtered(shown: Array, gel: GelRelaxation | None) -> Array:
    """Readings with relaxation taken out, frame by frame."""
    if gel is None:
        return shown
    relaxation, seen = RelaxationFilter(gel), np.ones((1, 1), np.uint8)
    found = [
        relaxation.effective(np.full((1, 1, 3), value), seen, round(1e9 * k * FRAME_S))
        for k, value in enumerate(shown)
    ]
    return np.array(found)[:, 0, 0, 0]


def loop_width(period: float, terms: Terms, gel: GelRelaxation | None) -> float:
    """Largest difference of the readings at one force, in the last of many cycles 0 to 1."""
    slowest = max(tau for _, tau in terms)
    cycles = math.ceil(min(5 * slowest, 60.0) / period) + 2
    time = np.arange(0, cycles * period, FRAME_S)
    force = (1 - np.cos(2 * np.pi * time / period)) / 2
    off = read(force, terms, gel) - force
    # Both halves of the last cycle, at the same forces.
    start = (cycles - 1) * period
    way = np.linspace(0.05, 0.45, 81) * period
    up = np.interp(start + way, time, off)
    down = np.interp(start + period - way, time, off)
    return float(np.abs(up - down).max())


def fitted(terms: Terms, hold_s: float) -> tuple[GelRelaxation, float]:
    """One term fitted to a weight on a gel of several, and the scale that belongs to it."""
    force = history([(0, 0), (0.5, 0), (0.6, 1), (0.6 + hold_s, 1)])
    noise = np.random.default_rng(0).normal(0, NOISE, len(force))
    time = FRAME_S * np.arange(len(force))
    outcome = fit_relaxation(time, shown_by(terms, force) + noise, 1.0)
    if outcome.relaxation is None:
        raise SystemExit(outcome.verdict)
    print(f"  {hold_s:g} s: {outcome.verdict}")
    for finding in outcome.findings:
        print(f"    {finding.severity.name.lower()}: {finding.text}")
    return outcome.relaxation, outcome.scale


def noise_rows() -> None:
    """How much of the reading's noise comes through."""
    noise = np.random.default_rng(1).normal(0, 1, 20_000)
    for terms in GELS:
        gel = GelRelaxation(*terms[0])
        print(
            f"noise, {gel.share:g}, {gel.time:g} s: factor {filtered(noise, gel)[2000:].std():.4f}"
        )


def contact_rows() -> None:
    """Contacts of a sphere: largest error of the resultant, % of the largest."""
    gel = GelRelaxation(0.2, 2.0)
    print(f"\nSphere of 6 mm on the sample rig, {gel.share:g}, {gel.time:g} s, friction 0.5")
    print(f"{'':34}" + "".join(f"{head:>14}" for head in ("elastic", "left in", "taken out")))
    for model, depth in (("linear", 4e-4), ("neo_hookean", 2e-4), ("neo_hookean", 4e-4)):
        elastic = with_gel(load_sensor("sample_rig"), model, None)
        inverse = ForceModel(elastic)
        plain = contact_errors(inverse, elastic, depth, (None,))
        relaxing = contact_errors(inverse, with_gel(elastic, model, gel), depth, (None, gel))
        values = "".join(f"{100 * value:14.2f}" for value in plain + relaxing)
        print(f"{model + f', {1e3 * depth:g} mm':34}{values}")


def with_gel(sensor: SensorDescription, model: str, gel: GelRelaxation | None) -> SensorDescription:
    """The sensor with a gel of another material."""
    return replace(sensor, elastomer=replace(sensor.elastomer, model=model, relaxation=gel))


def contact_errors(
    inverse: ForceModel,
    sensor: SensorDescription,
    depth: float,
    gels: tuple[GelRelaxation | None, ...],
) -> list[float]:
    """Largest error of the force through press, hold, shear, weight and release, as a share.

    gels: relaxations to correct, one figure for each.
    """
    elastomer = elastomer_of(sensor, CONTACT_NODES)
    simulation = ContactSimulation(elastomer, Sphere(0.006), 0.5)
    filters = [None if gel is None else RelaxationFilter(gel) for gel in gels]
    markers = inverse.elastic.markers
    status = np.ones((markers.rows, markers.cols), np.uint8)
    for relaxation in filters:
        if relaxation is not None:
            relaxation.effective(np.zeros((*status.shape, 3)), status, 0)
    state = simulation.rest(simulation.touch(Pose(np.array([0.0, 0.0, 0.02]), np.eye(3))))
    time, largest, errors = 0.0, 0.0, np.zeros(len(gels))
    for seconds, act in handling(simulation, depth):
        elastomer.advance(state.force, seconds)
        state = act(state)
        time += seconds
        seen = elastomer.marker_displacement(state.force)
        moved = at_markers(elastomer.observers, markers, seen)
        for number, relaxation in enumerate(filters):
            shown = moved
            if relaxation is not None:
                shown = relaxation.effective(moved, status, round(1e9 * time))
            found = inverse.reconstruct(shown, status).wrench[:3]
            off = float(np.linalg.norm(found - state.resultant))
            errors[number] = max(errors[number], off)
        largest = max(largest, float(np.linalg.norm(state.resultant)))
    return list(errors / largest)


def handling(simulation: ContactSimulation, depth: float) -> list[tuple[float, Act]]:
    """Times in s, and what is done in each."""

    def by(x: float, z: float) -> Act:
        return lambda state: simulation.move(
            state, Pose(state.pose.position + [x, 0, z], state.pose.rotation)
        )

    def weigh(share: float) -> Act:
        def act(state: ContactState) -> ContactState:
            normal = -share * state.resultant[2]
            return simulation.press(state, Load(normal, (0.1 * normal, 0.0)))

        return act

    press = [(0.1, by(0, -depth / 2))] * 2
    hold = [(0.5, by(0, 0)), (4.0, by(0, 0))]
    shear = [(0.2, by(depth / 4, 0))] * 2
    weight = [(0.2, weigh(0.8)), (4.0, weigh(1.0))]
    release = [(0.1, by(0, depth / 2))] * 3 + [(1.0, by(0, 0))]
    return press + hold + shear + weight + release


if __name__ == "__main__":
    main()
