"""Pages of the calibrations.

In: a calibration outcome.
Out: figures and one page.
"""
