"""From the grids of the views to points in 3-D.

In: one or two `Grid`s.
Out: `Markers3D`: corners and virtual markers, covariance, ray gap.
"""
