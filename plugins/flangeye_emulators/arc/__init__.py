"""Simulated power sources."""
