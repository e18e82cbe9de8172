"""Points along the gridlines between the corners.

In: `PreparedImage` and the corners of the grid.
Out: virtual markers with their standard deviation.
"""
