"""``scan.simulated``: a simulated workpiece."""
