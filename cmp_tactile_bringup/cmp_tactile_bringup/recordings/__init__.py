"""Recordings by name or path.

In: a bag, images, or the name of a packaged scene.
Out: where it is, its sensor, and what was computed of its frames.
"""
