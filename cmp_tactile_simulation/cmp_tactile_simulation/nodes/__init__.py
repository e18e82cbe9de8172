"""The node that simulates a gripper whose fingertips are sensors.

In: a scene of a grasp, and what a controller asks of the gripper.
Out: frames of both sensors, poses and true wrenches.
"""
