"""Numbers against truth, figures, HTML pages.

In: results of a played recording or of a calibration.
Out: figures and one page.
"""
