"""What RViz shows.

In: `Surface`, `ForceField`, `Grid`.
Out: markers and overlays, without NaN.
"""
