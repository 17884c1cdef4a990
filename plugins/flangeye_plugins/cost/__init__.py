"""Costs: what solve.iterative minimises."""
