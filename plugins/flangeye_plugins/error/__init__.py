"""``error.*``: how solve.iterative measures a candidate. Add one: a function in ``errors``."""
