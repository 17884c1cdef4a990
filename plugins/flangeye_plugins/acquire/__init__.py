"""``acquire.*``: where scans and robot poses come from. Add a source: a new module here."""
