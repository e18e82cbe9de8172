"""Flaws of the printed pattern.

In: frames at rest and their grids.
Out: `PrintDefects`: missing ink, dirt, ragged edges, and which markers they make doubtful.
"""
