"""Closed forms of the literature, each from its paper. Arrays only."""
