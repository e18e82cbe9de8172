"""The detector of the paper: checkers as quadrangles.

In: `PreparedImage`.
Out: a `CornerGraph`.
"""
