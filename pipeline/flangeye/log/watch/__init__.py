"""``flangeye watch``: a run as it goes, in the terminal and in Foxglove; all of it from its log."""

from flangeye.log.watch.command import watch_run

__all__ = ["watch_run"]
