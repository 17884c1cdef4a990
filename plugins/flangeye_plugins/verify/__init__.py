"""``verify.*``: tests whether a calibration may be used. Add one: a new module here."""
