"""Where the page's snapshots come from: recordings, topics of ROS.

In: a path, or a namespace.
Out: a `Source`, which gives snapshots while somebody looks.
"""
