"""What a calibration is made from.

In: recordings, running sensors, files of known loads.
Out: frames and load samples; the files of an accepted calibration.
"""
