"""Nodes on the real rclpy, each a program of its own."""

import os
import sys

# Behind the tests' own packages; only in the processes that are peers.
sys.path += filter(None, [os.environ.get("FLANGEYE_TESTS_ROS2_SITE")])
