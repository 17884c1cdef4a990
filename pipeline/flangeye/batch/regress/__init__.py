"""``flangeye regress``: recordings with what is known of them, run as a batch and compared."""

from flangeye.batch.regress.compare import Manifest, ManifestComparison, compare, read_manifests

__all__ = ["Manifest", "ManifestComparison", "compare", "read_manifests"]
