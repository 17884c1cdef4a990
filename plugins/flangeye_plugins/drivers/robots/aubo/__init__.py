"""Arms of AUBO."""
