"""Frames that are hard to track, with their truth.

In: a rig, deformations made by hand, covers, flaws.
Out: single frames and sequences, and scores of a tracked grid.
"""
