"""``scanner.*`` drivers, one module per scanner; an SDK is imported when opening a device."""
