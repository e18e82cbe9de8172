"""USB cameras.

In: a device, a mode, controls.
Out: a source of frames that survives being unplugged; its controls as parameters.
"""
