"""``solve.*``: solvers as stages, a module each; their mathematics is ``flangeye.estimation``."""
