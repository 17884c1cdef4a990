"""Malformed input of every sort: one line and an exit code, never a traceback."""
