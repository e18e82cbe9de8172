"""From points in 3-D to how the surface moved.

In: `Markers3D` over time.
Out: the reference, drift and stillness, `Surface`, and the dense surface.
"""
