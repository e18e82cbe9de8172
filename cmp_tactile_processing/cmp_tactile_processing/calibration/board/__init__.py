"""Cameras and mirrors from images of a calibration board.

In: images of a chessboard or ChArUco board.
Out: intrinsics, mirrors and views with their uncertainty.
"""
