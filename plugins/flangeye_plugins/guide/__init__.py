"""``guide.*``: procedures that guide a person through a measurement."""
