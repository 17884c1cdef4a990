"""``acquire.*`` stages: sources of scans and robot poses, one module per source."""
