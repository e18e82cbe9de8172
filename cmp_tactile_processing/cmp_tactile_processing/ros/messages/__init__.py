"""Messages from arrays and back.

In: types of `measured`, images, camera models.
Out: ROS messages of the same content, checked when they are read.
"""
