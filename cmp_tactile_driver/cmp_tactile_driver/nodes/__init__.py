"""The nodes camera_driver, recorder and replay.

In: sources, bags, topics.
Out: frames and camera models on topics; recordings.
"""
