"""``fit.*``: circle centre or marker pose, with covariance. Add a fit: a new module here."""
