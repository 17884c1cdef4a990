"""``seam.*``: where to weld, by CAD or by the groove in a scan. Add a source: a new module."""
