"""A folder of its own: the other Python looks for modules here first, and finds no others."""
