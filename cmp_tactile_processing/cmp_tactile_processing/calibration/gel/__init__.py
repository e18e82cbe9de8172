"""The rig from the gel's own pattern.

In: observed grids of a gel at rest or moved.
Out: the parameters of the rig that the grids determine.
"""
