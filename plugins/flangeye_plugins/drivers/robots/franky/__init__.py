"""Arms of Franka Robotics."""
