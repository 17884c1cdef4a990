"""``flangeye regress``: recordings with what is known of them, run as a batch and compared."""

from flangeye.batch.regress.compare import Comparison, Manifest, compare, read_manifests

__all__ = ["Comparison", "Manifest", "compare", "read_manifests"]
