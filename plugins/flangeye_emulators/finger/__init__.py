"""Simulated compliant finger: a tip in a groove, and its camera's images of the tag."""
