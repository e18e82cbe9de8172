"""A gripper whose fingertips are sensors, in a rigid world of MuJoCo.

In: a scene of a grasp.
Out: frames of both fingertips with their truth, and poses of what is held.
"""
