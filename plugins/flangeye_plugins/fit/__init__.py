"""``fit.*`` stages: fit a circle's centre or a target's pose, with covariance."""
