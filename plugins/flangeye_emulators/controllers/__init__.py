"""Emulated robot controllers on loopback, each a process of its own.

A vendor's unmodified client library connects to it and cannot tell the difference. The modules
here know arms, not vendors: poses, paths, speeds, contact, faults, the clock, the control channel.
``ur`` adds the protocols of Universal Robots, ``aubo`` that of AUBO.

Conventions: SI units. Six-vectors are translation first, as controllers have them: a pose is
(x, y, z, rotation vector), a twist (linear, angular), a wrench (force, torque). A target of motion
is an array: six joint angles, or a (4, 4) ``base_T_tcp``.
"""
