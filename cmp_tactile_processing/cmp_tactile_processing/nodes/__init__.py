"""ROS 2 nodes around the stages of the core."""
