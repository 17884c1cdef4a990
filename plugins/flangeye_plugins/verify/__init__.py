"""``verify.*``: whether a calibration may be used."""
