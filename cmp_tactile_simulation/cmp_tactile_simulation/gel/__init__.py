"""The gel under contact: linear, neo-Hookean, relaxing.

In: `SensorDescription`, tractions on the contact nodes.
Out: displacements of contact nodes and markers.
"""
