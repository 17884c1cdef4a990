"""``segment.*``: find the flange or a sphere in a scan. Add a way to find it: a new module."""
