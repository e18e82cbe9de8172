"""A printed pattern in words and numbers, and as files.

In: sheets of `cmp_tactile_processing.printing`.
Out: what to print, how to mount it, what will be seen; SVG, PDF, DXF, and the description that
agrees.
"""
