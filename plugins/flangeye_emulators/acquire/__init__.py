"""``acquire.simulated*``: captures from simulated cells, whose truth is known."""
