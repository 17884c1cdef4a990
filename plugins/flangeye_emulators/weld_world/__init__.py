"""The truth of a simulated weld: arm, tool, finger, clock, workpiece and heat as they really are.

A controller is given files that differ from it by stated amounts; nothing here is reachable from
one. All is in the plane of the work, lengths in metres.
"""
