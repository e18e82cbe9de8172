"""Graph files: which components run, with which names and parameters.

In: a YAML file and arguments.
Out: `Graph`, launch actions, RViz settings, documentation tables.
"""
