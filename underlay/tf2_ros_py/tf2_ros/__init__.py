"""Stand-in for the transform broadcasters of tf2_ros, for machines without that package."""

from .static_transform_broadcaster import StaticTransformBroadcaster
from .transform_broadcaster import TransformBroadcaster

__all__ = ["StaticTransformBroadcaster", "TransformBroadcaster"]
