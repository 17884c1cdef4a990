"""``segment.*`` stages: find the flange, a sphere or a body in a scan."""
