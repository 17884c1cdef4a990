"""``scanner.*``: scanners, a module each, which imports its SDK when it opens a device."""
