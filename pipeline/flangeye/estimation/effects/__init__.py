"""Errors that a cell can have: each effect has a design block and a typical size."""
