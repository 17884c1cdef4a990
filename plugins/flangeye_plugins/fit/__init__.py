"""``fit.*``: circle centre or marker pose with covariance."""
