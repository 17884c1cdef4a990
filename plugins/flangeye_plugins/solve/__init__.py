"""``solve.*`` stages: solvers; their mathematics is in ``flangeye.estimation``."""
