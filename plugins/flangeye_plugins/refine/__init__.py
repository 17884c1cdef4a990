"""``refine.*``: change a calibration after solving. Add a refinement: a new module here."""
