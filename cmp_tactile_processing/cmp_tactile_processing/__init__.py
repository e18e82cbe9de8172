"""Processing core of cmp_tactile: from a camera frame to the force on the gel, without ROS."""
