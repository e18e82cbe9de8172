"""Where frames come from.

In: options of a source.
Out: `FrameSource`: images, videos, and what other packages register.
"""
