"""What a node of this suite stands on.

In: stages of the core, ROS 2.
Out: stage nodes with parameters, intra-process messages, lifecycle of a process.
"""
