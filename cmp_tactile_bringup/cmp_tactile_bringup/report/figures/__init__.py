"""Figures of the report.

In: `DemoResults`.
Out: PNG files and an animation.
"""
