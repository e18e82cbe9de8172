"""From the displacement of the surface to the force on the gel.

In: `Surface`, `SensorDescription`.
Out: `ForceField`: traction, contacts, wrench and their covariance.
"""
