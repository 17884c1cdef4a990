"""``robot.*``: drivers, a folder for each maker; client libraries are imported on connecting."""
