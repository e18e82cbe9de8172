"""Recordings by name or path.

In: a bag, images, or the name of a packaged scene.
Out: `Recording` with its sensor and its truth; arrays of its frames.
"""
