"""The picture of a deformed pattern.

In: a deformed surface, ink, camera settings.
Out: frames, and where corners and gridlines truly are.
"""
