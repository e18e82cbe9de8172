"""Graphs: which components run, with which names and parameters.

In: the name of a packaged graph or a Python file, and arguments.
Out: `Graph`, launch actions, RViz settings, documentation tables.
"""
