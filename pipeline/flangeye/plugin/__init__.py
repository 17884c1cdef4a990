"""Interface for plugins: stages, parts, their contracts, hooks, and the registry."""
