"""The bridge process; alone in its folder, as ROS 2's Python must import nothing else of ours."""
