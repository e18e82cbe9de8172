"""Stick, slip and friction of the contacts.

In: `Surface` and `ForceField`, frame by frame.
Out: a slip estimate for each contact.
"""
