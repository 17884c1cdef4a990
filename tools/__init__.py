"""Programs that make tables, pages and samples; each is run with ``python -m tools.NAME``."""
