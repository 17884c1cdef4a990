"""``acquire.simulated*`` stages: captures from simulated cells with known truth."""
