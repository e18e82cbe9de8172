"""Stand-in for the Python conversions of cv_bridge, for machines without that package."""

from .core import CvBridge
from .errors import CvBridgeError

__all__ = ["CvBridge", "CvBridgeError"]
