"""``flangeye ui``: a local page over the same recipes, runs and logs as the command line.

It contains no calibration logic: the engine checks recipes, runs are processes of the command line,
and pages show their logs.
"""

from flangeye_ui.server import serve

__all__ = ["serve"]
