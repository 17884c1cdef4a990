"""Robots, scanners and sensors, each behind the same Protocol; see README.md."""
