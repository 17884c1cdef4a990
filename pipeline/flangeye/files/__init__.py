"""What is read from disk: YAML with lines, point clouds, recordings, bundled files."""
