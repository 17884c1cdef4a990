"""``weld.*``: following a seam by touch, torch behind; what leads it is a ``controller.*``."""
