"""Rays: how a point of the gel is seen in a pixel, and the other way round.

In: `SensorDescription`, pixels or points.
Out: rays, projections, split and rectified views, camera models; SI units, gel frame.
"""
