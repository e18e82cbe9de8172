"""Whether a recording agrees with its description.

In: grids of a recording.
Out: findings: which part of the description does not hold.
"""
