"""``scan.*``: scans of the workpiece. Add a way to scan it: a new module here."""
