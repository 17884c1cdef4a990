"""Arms with a ROS 2 driver: moved by us, or by others."""
