"""``sensor.*``: cameras that watch a compliant finger. Add a source of images: a new module."""
