"""``verify.*`` stages: tests whether a calibration may be used."""
