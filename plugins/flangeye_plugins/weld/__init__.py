"""Tactile welding: following a seam with a compliant finger, the torch behind it."""
