"""``weld.*``: follow a seam by touch, with the torch behind; a ``controller.*`` part steers."""
