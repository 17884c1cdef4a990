"""``scan.*``: scans of the workpiece."""
