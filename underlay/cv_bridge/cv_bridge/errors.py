"""The exception of this package."""


class CvBridgeError(TypeError):
    """An image that cannot be converted."""
