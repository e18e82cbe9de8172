"""The gel as a finite-element model, without measurements.

In: `SensorDescription`, meshes, loads or displacements.
Out: stiffness, compliance and factors, linear and neo-Hookean.
"""
