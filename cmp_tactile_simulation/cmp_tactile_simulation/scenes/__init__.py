"""Scenes: what is simulated, over time.

In: a YAML file.
Out: frames of the simulation with their truth.
"""
