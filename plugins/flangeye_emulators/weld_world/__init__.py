"""The true world of a simulated weld: arm, tool, finger, clock, workpiece and heat.

The controller gets files whose values differ from the truth within stated tolerances, and has no
access to this package. Coordinates are in the plane of the work, in metres.
"""
