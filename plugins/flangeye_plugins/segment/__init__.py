"""``segment.*``: find the flange or sphere in a scan."""
