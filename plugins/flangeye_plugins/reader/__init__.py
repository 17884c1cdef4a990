"""``reader.*``: layouts of archives and tables of poses. Add a layout: a new module here."""
