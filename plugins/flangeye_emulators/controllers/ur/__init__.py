"""A controller of Universal Robots, as the ur_rtde client library (1.6) knows it.

Ports: RTDE 30004, script upload 30003, dashboard 29999. The control script that ur_rtde uploads is
not interpreted: ``script.py`` does natively what of it the project's driver asks for. Waypoints and
blends, servoing, force mode and contact detection are not imitated.
"""
