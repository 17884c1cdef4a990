"""Kinematics, statistics and fits that any room above may use. Arrays only."""
