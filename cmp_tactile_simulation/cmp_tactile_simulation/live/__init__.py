"""A simulated sensor in real time.

In: a scene and commands to the indenter.
Out: the driver's source `simulated`, and its topics.
"""
