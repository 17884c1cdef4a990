"""ROS 2 as this computer has it: a bridge process under its own Python, and what it carries."""
