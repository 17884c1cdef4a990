"""``verify.*``: whether a calibration may be used. Add a test of it: a new module here."""
