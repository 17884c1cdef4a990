"""Geometry, kinematics and statistics that any room may use. Arrays only."""
