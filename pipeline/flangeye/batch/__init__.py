"""A recipe over many archives, parameter values and seeds: ``flangeye batch``."""

from __future__ import annotations

from flangeye.batch.command import run_batch
from flangeye.batch.progress import summary_text
from flangeye.batch.request import Request

__all__ = ["Request", "run_batch", "summary_text"]
