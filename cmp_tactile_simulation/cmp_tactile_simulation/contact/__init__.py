"""Frictional contact of an indenter and the gel.

In: a gel, an indenter, a pose or a load.
Out: `ContactState`: tractions, displacements, stick and slip.
"""
