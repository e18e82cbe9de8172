"""Stand-in for the Python conversions of cv_bridge, for machines without that package."""

from cv_bridge.core import CvBridge
from cv_bridge.errors import CvBridgeError

__all__ = ["CvBridge", "CvBridgeError"]
