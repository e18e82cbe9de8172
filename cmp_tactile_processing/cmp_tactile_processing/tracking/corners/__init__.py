"""Corners of the pattern: found, and measured to a fraction of a pixel.

In: `PreparedImage`.
Out: a `CornerGraph` of the detector `saddle_lattice`, and measured markers.
"""
