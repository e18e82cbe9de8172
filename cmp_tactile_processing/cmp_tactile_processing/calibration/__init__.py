"""A sensor description from measurements.

In: images of a board, frames of the gel, known loads.
Out: `CalibrationOutcome`: the new description, findings, residuals.
"""
