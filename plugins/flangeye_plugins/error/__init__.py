"""``error.*``: how solve.iterative measures a candidate. Add one: a new module here."""
