"""Reading from disk: YAML with line numbers, point clouds, recordings, bundled files."""
