"""Arms: ``robot.*``."""
