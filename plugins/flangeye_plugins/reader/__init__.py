"""Readers: the archive layouts that ``acquire.archive`` and ``acquire.centres`` can read."""
