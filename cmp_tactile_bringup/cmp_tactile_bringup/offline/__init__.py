"""Recordings through the pipeline into files, without a running ROS.

In reading order: what is asked for (`jobs`), one recording or several at once
(`processor`), and what is written (`outputs`).
"""
