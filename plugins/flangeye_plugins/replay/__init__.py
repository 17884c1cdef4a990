"""``replay.*``: decisions of a step repeated from its log. Add a step: a new module here."""
