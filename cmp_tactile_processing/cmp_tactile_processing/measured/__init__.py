"""What the stages measure and exchange.

In: nothing; these are the types.
Out: `Grid` (2-D), `Markers3D`, `Surface`, `ForceField`, and `SurfaceGrid`.
"""
