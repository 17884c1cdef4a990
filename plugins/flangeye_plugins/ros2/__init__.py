"""Access to ROS 2: a bridge process under ROS 2's own Python, and its protocol."""
