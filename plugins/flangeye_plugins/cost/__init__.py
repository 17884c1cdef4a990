"""``cost.*``: what solve.iterative minimises. Add a cost: a function in ``costs``."""
