"""``sensor.*``: cameras that watch a compliant finger."""
