"""Emulated robot controllers on loopback, each in its own process.

A vendor's unmodified client library connects to them as to a real controller. The modules here are
common to all makers: poses, paths, speeds, contact, faults, clock, control channel. ``ur`` adds the
protocols of Universal Robots, ``aubo`` that of AUBO.

Conventions: SI units. Six-vectors are translation first, as in controllers: a pose is (x, y, z,
    rotation vector), a twist (linear, angular), a wrench (force, torque). A motion target is an
    array: joint angles (n,), or ``base_T_tcp`` (4, 4).
"""
