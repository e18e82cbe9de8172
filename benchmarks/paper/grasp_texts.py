"""What the page says about V.D's set-up and its deviations from the paper's."""

from __future__ import annotations

from paper.experiment import Deviation, Text

__all__ = ["DEFINITIONS", "DEVIATIONS", "SETUP", "force_and_knock"]

SETUP = Text(
    "The handle of a hexagonal wrench, 5 mm across flats, is pressed 0.8 mm into the gel, dragged "
    "0.8 mm along its axis, knocked back by 1.65 mm within one frame of 1/30 s, held, knocked "
    "again and let go.  All methods see the same deformation, on the print that each reads, "
    "through the same triangulation and the same force model; the reference is the gel at rest, "
    "seen by the method itself.  The truth is the force that the simulated bar exerts."
)
DEFINITIONS = Text(
    "One scene is an anecdote: at which jump per frame does each method begin to fail?  The same "
    "bar is pushed slowly through three pitches along itself, across and diagonally, and frames "
    "are left out: the gel is followed in steps of 0.2 pitches to where the knock begins, and the "
    "next frame shows it beyond the middle, forwards and backwards.  A jump is that of the marker "
    "that moves furthest, in 3-D.  A knock of many pitches also ends in steep shear, half its size "
    "over the few checkers beside the bar; a method that fails there fails for the shear if it "
    "does so, too, where the same place is reached in small steps.  "
    "The optical flow numbers anew by the grid's order where it has lost many dots: a knock that "
    "is too large for it to follow it may stand, where a smaller one misleads it."
)
DEVIATIONS = (
    Deviation(
        "grasp",
        "two sensors on a gripper of a robot, a person disturbs the wrench by hand",
        "one simulated sensor (the `prototype`), the wrench moves on a given path",
        "no robot; each method is to see the same grasp",
    ),
    Deviation(
        "what was known beforehand",
        "not told",
        "of CMP's tracker, how far a complete grid may jump from corner to corner before a part of "
        "it is taken for another pattern was set with a view to a gel that such a bar shears, and "
        "to a cuboid's corner; all other settings are from other frames",
        "an earlier rule took away corners of a gel that is bent steeply: read the largest knocks "
        "of CMP as what it was mended for",
    ),
    Deviation(
        "friction",
        "not told",
        "Coulomb's coefficient of 0.9: the bar sticks",
        "a sliding wrench would move the gel less",
    ),
    Deviation(
        "truth",
        "none: the two sensors' forces are shown beside each other",
        "the simulated force; gel and force model rest on the same linear elasticity with the "
        "same moduli, so these errors leave out those of a calibration",
        "matching is judged here, not the material",
    ),
    Deviation(
        "camera",
        "the gripper's light and shutter",
        "sharp frames with little noise",
        "the knock alone is judged",
    ),
)


def force_and_knock(force: tuple[float, float, float], jump: float) -> Deviation:
    """force: the largest true ones along x, y, z, N; jump: of the gel in the knock, pitches."""
    return Deviation(
        "force and knock",
        "not told",
        f"up to {force[2]:.2g} N pressing, {force[0]:.2g} N along the bar; the gel jumps by "
        f"{jump:.2g} pitches, twice",
        "chosen so that the jump is larger than the distance of the markers; the sweep tells of "
        "all other sizes",
    )
