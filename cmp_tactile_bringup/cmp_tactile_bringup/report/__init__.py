"""The report of a played recording: numbers against truth, figures, one HTML page."""
