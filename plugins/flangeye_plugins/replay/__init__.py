"""``replay.*``: decisions of a step repeated from its log."""
