"""Stiffness and relaxation of the gel from known loads.

In: samples of displacement beside a known load.
Out: Young's modulus, Poisson's ratio, relaxation, with uncertainty.
"""
