"""The estimator: one linear mixed model of a cell, and the questions that are asked of it.

``graph`` predicts what cameras see from the places in a cell. ``effects`` holds what can be wrong
with it, one file each. ``mixed`` estimates places, effects and their sizes together. ``calibrate``
is the way from observations to an answer.
"""
