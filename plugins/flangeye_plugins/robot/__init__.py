"""``robot.*`` drivers, one folder per maker; client libraries are imported when connecting."""
