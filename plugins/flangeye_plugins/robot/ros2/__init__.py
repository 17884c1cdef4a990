"""Arms with a ROS 2 driver: driven by flangeye, or moved by others."""
