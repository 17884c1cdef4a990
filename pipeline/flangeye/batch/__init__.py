"""A recipe over many archives, parameter values and seeds: ``flangeye batch``."""

from __future__ import annotations

from flangeye.batch.command import run_batch
from flangeye.batch.outcome import Request
from flangeye.batch.progress import summary_text

__all__ = ["Request", "run_batch", "summary_text"]
