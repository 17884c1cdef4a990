"""``plan.*``: where the arm is sent to be scanned. Add a plan: a new module here."""
