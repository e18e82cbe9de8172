"""Recordings through the pipeline into files, without a running ROS.

In reading order: what is asked for (`jobs`), one recording (`processor`), what is written
(`outputs`), and where the work is done (`workers`).
"""
