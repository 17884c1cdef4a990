"""``solve.*``: solvers as stages; the mathematics is in ``flangeye.handeye``."""
