"""Recordings through the pipeline into files, without a running ROS.

In reading order: what is asked for (`jobs`), one recording (`task`, `processor`), what is written
(`result_files`, `result_writers`), and where the work is done (`workers`, `cluster`, `display`).
"""
