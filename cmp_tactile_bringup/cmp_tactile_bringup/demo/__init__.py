"""A recording played through the nodes, over real topics.

In: a recording.
Out: what the nodes published, matched by stamp.
"""
