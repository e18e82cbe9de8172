"""The pattern as a drawing to be printed.

In: `SensorDescription`, sheet size, margins.
Out: outlines on sheets in m, and advice on the choice of a pattern.
"""
