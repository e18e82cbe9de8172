"""Recordings through the pipeline into files, without a running ROS.

In reading order: what is asked for (`jobs`), what is read (`inputs`), what is written
(`result_bag`, `result_tables`, `result_files`), one recording (`processor`, `task`), and where the
work is done (`here`, `processes`, `cluster`).
"""
