"""Built-in plugins of one kind."""
