"""``robot.*``: arms, a folder for each maker, whose client is imported when it connects."""
