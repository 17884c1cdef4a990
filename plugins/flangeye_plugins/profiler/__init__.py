"""``profiler.*``: sensors that look at the bead behind the torch. Add one: a new module."""
