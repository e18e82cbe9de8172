"""Which corner is which.

In: a `CornerGraph` and the nominal grid.
Out: numbers (i, j) of the corners; missing with a reason where they are not certain.
"""
