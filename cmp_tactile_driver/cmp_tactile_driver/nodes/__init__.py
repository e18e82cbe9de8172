"""ROS 2 nodes of the driver: thin adapters around frame sources and recordings."""
