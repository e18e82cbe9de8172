"""Datasets and bags as data sets that other programs read.

In reading order: further topics of a bag (`topics`), the frames of each sample or bag on one clock
(`episodes`), and the files of LeRobot (`lerobot`).
"""
