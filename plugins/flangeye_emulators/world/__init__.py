"""Simulated cell with known truth: an arm, its flange, surroundings, and scanners."""
