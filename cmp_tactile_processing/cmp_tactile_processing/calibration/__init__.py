"""Calibration of a sensor's optics: from images of a board, and from its own pattern at rest."""
