"""Drawing what was measured, for RViz and the browser alike.

In: grids, surfaces and forces.
Out: colours, points of arrows and outlines, words, and images with gridlines; no ROS.
"""
