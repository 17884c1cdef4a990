"""Hand-eye calibration of any cell, as arrays: what the frames are, and how well they are known.

An arm's own error is part of the estimate: :class:`flangeye.types.ArmCorrection` holds it (tool
offset, joint offsets, smooth field), :func:`flangeye.maths.arm_correction.corrected_flange` moves
a reported flange by it, :mod:`flangeye.maths.smooth_field` evaluates the field and its covariance.
"""
