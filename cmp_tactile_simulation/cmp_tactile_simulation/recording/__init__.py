"""Simulated frames in files.

In: a scene.
Out: a bag, images or a video with the truth; an interrupted run goes on.
"""
