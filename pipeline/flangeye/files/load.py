"""How busy this computer is, for messages about what came too late."""

from __future__ import annotations

import os


def busy() -> str:
    """Return what to do about a computer that has more to do than it can; else nothing."""
    cores = os.cpu_count() or 1
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    if load <= cores:
        return ""
    return (
        f"; this computer is busy (load {load:.1f} on {cores} cores): end what else runs on it, "
        "then start again"
    )
