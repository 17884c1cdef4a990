"""The door for plugins: stages, parts, their contracts, hooks, and the registry that finds them."""
