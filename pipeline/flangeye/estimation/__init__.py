"""The estimator: one linear mixed model of a cell, and what is derived from it.

``graph`` predicts what cameras see from the places in a cell. ``effects`` holds the cell's possible
errors, one file each. ``start`` finds places to begin at; ``mixed`` estimates places, effects and
their sizes together. ``calibrate`` leads from a ``session`` to its ``answers``.
"""
