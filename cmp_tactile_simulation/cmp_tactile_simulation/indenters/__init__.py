"""Rigid bodies that press the gel.

In: shape and size, or a mesh file.
Out: signed distance and normal at any point.
"""
