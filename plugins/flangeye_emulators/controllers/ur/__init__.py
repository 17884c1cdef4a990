"""An emulated controller of Universal Robots for the ur_rtde client library (1.6).

Ports: RTDE 30004, script upload 30003, dashboard 29999. The control script that ur_rtde uploads is
    not interpreted: ``script.py`` implements the commands that the project's driver uses. Waypoints
    with blends, servoing, force mode and contact detection are not emulated.
"""
