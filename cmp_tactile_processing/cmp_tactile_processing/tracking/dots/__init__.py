"""The dots of coded patterns.

In: connected corners in an image, and which checkers of the sheet bear dots.
Out: the dots that are seen, where on the sheet they are, and the image without them.
"""
