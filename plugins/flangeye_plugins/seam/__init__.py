"""``seam.*``: where to weld, from CAD or from the groove in a scan."""
