"""``flangeye ui``: a local page over the same recipes, runs and logs as the command line.

It holds no logic of calibration: recipes are checked by the engine, runs are processes of the
command line, and what a page shows comes from their logs.
"""

from __future__ import annotations

from flangeye_ui.server import serve

__all__ = ["serve"]
