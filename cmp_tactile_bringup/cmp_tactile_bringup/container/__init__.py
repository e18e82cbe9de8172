"""Components in one process.

In: a graph, or requests to load components.
Out: a running container, of this process or of another.
"""
