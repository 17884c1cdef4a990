"""``solve.*`` stages: solvers; the estimator itself is ``flangeye.estimation``."""
