"""Pixels before any pattern is looked for.

In: image files, compressed messages, the grey image of a view.
Out: `PreparedImage`: filtered, with its noise and contrast.
"""
