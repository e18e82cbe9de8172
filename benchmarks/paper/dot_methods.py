"""The dot methods (DMP) and all methods that are compared."""

from __future__ import annotations

from paper.dot_tracker import AssignmentTracker, FlowTracker, GridOrderTracker, NearestTracker
from paper.method import CMP, CMP_PAPER, Method

__all__ = [
    "ALL_METHODS",
    "DMP_ASSIGNMENT",
    "DMP_FLOW",
    "DMP_GRID",
    "DMP_NEAREST",
    "FOLLOWING_METHODS",
]

DMP_NEAREST = Method("dmp_nearest", "DMP, nearest dot", "dmp", NearestTracker)
# Beyond II.A: all dots at once instead of the nearest one for each.
DMP_ASSIGNMENT = Method("dmp_assignment", "DMP, best assignment", "dmp", AssignmentTracker)
DMP_GRID = Method("dmp_grid", "DMP, grid order", "dmp", GridOrderTracker)
DMP_FLOW = Method("dmp_flow", "DMP, optical flow", "dmp", FlowTracker)
ALL_METHODS = (CMP, CMP_PAPER, DMP_NEAREST, DMP_GRID, DMP_FLOW)
# Where the numbering is what is judged.
FOLLOWING_METHODS = (CMP, CMP_PAPER, DMP_NEAREST, DMP_ASSIGNMENT, DMP_GRID, DMP_FLOW)
