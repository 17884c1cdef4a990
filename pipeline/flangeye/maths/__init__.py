"""Kinematics, statistics and fits on plain arrays, for all packages above this one."""
