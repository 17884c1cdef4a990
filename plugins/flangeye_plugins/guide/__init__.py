"""``guide.*``: procedures that guide a person in measuring. Add one: a new module here."""
