"""Any arm that ROS 2 has a driver for: one that it moves, and one that somebody else moves."""
