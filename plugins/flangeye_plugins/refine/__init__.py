"""``refine.*``: change a calibration after solving."""
