"""What is to be drawn, as arrays in millimetres: meshes, arrows, ellipsoids, time series.

In: surfaces and force fields.
Out: NumPy arrays; neither viser nor ROS.
"""
